"""Tables on standard output, for the terminal or for files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import StrEnum
from textwrap import fill
from typing import Annotated

import typer
from rich.console import Console
from rich.measure import Measurement
from rich.text import Text

from nss_ros.errors import InputError
from nss_ros.table import Align, Cell, Column, Table

_WIDEST = 10_000  # characters
_FRAME = 3  # characters around a single column


class TableFormat(StrEnum):
    """How tables are written."""

    RICH = "rich"
    MARKDOWN = "markdown"
    CSV = "csv"
    LATEX = "latex"


FormatOption = Annotated[
    TableFormat, typer.Option("--format", help="How tables are written.", show_choices=True)
]
TableOption = Annotated[
    list[str],
    typer.Option("--table", metavar="NAME", help="Only this table; may be given again."),
]


def chosen_tables(
    tables: Mapping[str, Table], names: Sequence[str], hidden: Sequence[str] = ()
) -> list[Table]:
    """The tables of these names; without names all but those that are hidden unless named.

    Raises:
        InputError: there is no such table.
    """
    for name in names:
        if name not in tables:
            raise InputError(f"There is no table '{name}' here; there are {', '.join(tables)}.")
    return [tables[name] for name in names or [n for n in tables if n not in hidden]]


def print_tables(tables: Sequence[Table], notes: Sequence[str], form: TableFormat) -> None:
    """Print notes and tables.

    CSV of one table is nothing but that table; several are told apart by lines that begin with #.
    """
    if form is TableFormat.RICH:
        console = Console()
        for note in notes:
            console.print(Text(note, "bold yellow" if note.startswith("PARTIAL") else "yellow"))
        for table in tables:
            console.print(Text(f"\n{table.title}", "bold"))
            for part in fitted(table, console.width):
                console.print(part.to_rich())
            if table.caption:
                console.print(Text(table.caption, "dim"))
        return
    mark = {TableFormat.MARKDOWN: "> ", TableFormat.CSV: "# ", TableFormat.LATEX: "% "}[form]
    parts = []
    if notes and (form is not TableFormat.CSV or len(tables) > 1):
        parts.append("".join(f"{mark}{note}\n" for note in notes))
    for table in tables:
        if form is TableFormat.MARKDOWN:
            parts.append(table.to_markdown())
        elif form is TableFormat.LATEX:
            parts.append(table.to_latex())
        else:
            title = f"# {table.title}\n" if len(tables) > 1 else ""
            parts.append(title + table.to_csv())
    print("\n".join(parts), end="")


def fitted(table: Table, width: int) -> list[Table]:
    """A table without title and caption, as tables of at most some width, in characters.

    Headings are broken where that is needed; if that is not enough, the columns are spread over
    several tables that all begin with the leading texts of the rows. No number is ever cut, so a
    table with a single further column may still be too wide.
    """
    bare = replace(table, title="", caption="")
    if _width(bare) <= width:
        return [bare]
    bare = replace(bare, columns=tuple(map(_broken, bare.columns, zip(*bare.rows, strict=True))))
    texts = (i for i, column in enumerate(bare.columns) if column.align is not Align.LEFT)
    keys = next(texts, len(bare.columns))
    parts: list[list[int]] = []
    for column in range(keys, len(bare.columns)):
        longer = [*(parts[-1] if parts else range(keys)), column]
        if parts and _width(_with_columns(bare, longer)) > width:
            parts.append([*range(keys), column])
        else:
            parts[-1:] = [longer]
    return [_with_columns(bare, part) for part in parts] or [bare]


def _width(table: Table) -> int:
    """The width without any line broken."""
    console = Console(width=_WIDEST)
    return Measurement.get(console, console.options, table.to_rich()).maximum


def _broken(column: Column, cells: tuple[Cell, ...]) -> Column:
    """A column whose heading is no wider than its cells and its longest word."""
    alone = Table("", (replace(column, name="", unit=""),), tuple((cell,) for cell in cells))
    words = [*column.name.split(), f"({column.unit})" if column.unit else ""]
    width = max(_width(alone) - _FRAME, *(len(word) for word in words))
    return replace(column, name=fill(column.name, width, break_long_words=False))


def _with_columns(table: Table, columns: Sequence[int]) -> Table:
    return replace(
        table,
        columns=tuple(table.columns[i] for i in columns),
        rows=tuple(tuple(row[i] for i in columns) for row in table.rows),
    )
