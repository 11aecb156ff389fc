"""One table, written for the terminal, for Markdown, for LaTeX, for the browser and as CSV."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from html import escape
from numbers import Integral, Real

from rich import box
from rich.cells import cell_len
from rich.table import Table as RichTable
from rich.text import Text

Cell = str | float | None
"""A text, a number (of Python or numpy), or None for what is not known."""

NOTHING = "-"
"""Stands for None and NaN where people read."""

_MINUS = "\N{MINUS SIGN}"


class Align(StrEnum):
    """Side to which a column is set."""

    LEFT = "left"
    RIGHT = "right"


@dataclass(frozen=True, slots=True)
class Column:
    """A column.

    Attributes:
        name: heading, without the unit.
        unit: of the numbers, put behind the name in parentheses; empty for none.
        form: format specification of the numbers, for example `.1f` or `,`.
        align: right, so that digits stand above each other, or left for texts.
    """

    name: str
    unit: str = ""
    form: str = ""
    align: Align = Align.RIGHT

    @property
    def heading(self) -> str:
        """Name and unit."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


@dataclass(frozen=True, slots=True)
class Table:
    """A table of texts and numbers.

    Attributes:
        title: what it shows.
        columns: from left to right.
        rows: one cell per column.
        caption: how it is to be read; may be empty.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[Cell, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        for row in self.rows:
            if len(row) != len(self.columns):
                raise ValueError(f"{self.title}: {len(row)} cells, {len(self.columns)} columns")

    def to_rich(self) -> RichTable:
        """For a console of rich."""
        table = RichTable(
            title=Text(self.title, "bold"),
            caption=Text(self.caption, "dim") if self.caption else None,
            title_justify="left",
            caption_justify="left",
            box=box.SIMPLE_HEAD,
            padding=(0, 0, 0, 1),
        )
        rows = self._texts()
        for number, column in enumerate(self.columns):
            # Where there is little room, headings are broken between words, and cells never.
            unbroken = [*column.heading.split(), *(row[number] for row in rows)]
            table.add_column(
                Text(f"{column.name}\n({column.unit})" if column.unit else column.name),
                justify="left" if column.align is Align.LEFT else "right",
                min_width=max((cell_len(text) for text in unbroken), default=0),
            )
        for row in rows:
            table.add_row(*(Text(cell) for cell in row))
        return table

    def to_markdown(self) -> str:
        """A GitHub-flavoured Markdown table between its title in bold and its caption."""
        head = [_markdown(column.heading) for column in self.columns]
        body = [[_markdown(cell) for cell in row] for row in self._texts()]
        widths = [max(3, *(cell_len(row[i]) for row in (head, *body))) for i in range(len(head))]
        rule = [
            "-" * width if column.align is Align.LEFT else "-" * (width - 1) + ":"
            for column, width in zip(self.columns, widths, strict=True)
        ]
        lines = [f"**{_markdown(self.title)}**", ""]
        lines += [self._markdown_line(row, widths) for row in (head, rule, *body)]
        if self.caption:
            lines += ["", _markdown(self.caption)]
        return "\n".join(lines) + "\n"

    def to_csv(self) -> str:
        """Headings and rows for programs: numbers unrounded, empty where nothing is known."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow([column.heading for column in self.columns])
        writer.writerows([[_csv(cell) for cell in row] for row in self.rows])
        return stream.getvalue()

    def to_latex(self) -> str:
        """A `table` environment with the rules of the package booktabs."""
        text = f"{self.title}. {self.caption}" if self.caption else f"{self.title}."
        lines = [
            r"\begin{table}",
            r"  \centering",
            rf"  \caption{{{_latex(text)}}}",
            rf"  \begin{{tabular}}{{{''.join(column.align[0] for column in self.columns)}}}",
            r"    \toprule",
            _latex_line([_latex(column.heading) for column in self.columns]),
            r"    \midrule",
            *(_latex_line(self._latex_cells(row)) for row in self.rows),
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n"

    def to_html(self, ids: Sequence[str] = ()) -> str:
        """A `table` element without attributes of style; its cells of numbers have a class.

        The title is its `caption`; what a page does with the table's own caption is up to it.

        Args:
            ids: the `id` of each row, to which links lead; empty for none.
        """
        classes = [
            "" if column.align is Align.LEFT else ' class="number"' for column in self.columns
        ]
        head = "".join(
            f'<th scope="col"{each}>{_html_heading(column)}</th>'
            for column, each in zip(self.columns, classes, strict=True)
        )
        lines = ["<table>", f"<caption>{escape(self.title)}</caption>"]
        lines += [f"<thead><tr>{head}</tr></thead>", "<tbody>"]
        for number, row in enumerate(self._texts()):
            begin = f'<tr id="{escape(ids[number])}">' if ids else "<tr>"
            cells = "".join(
                f"<td{each}>{_html_cell(text)}</td>"
                for text, each in zip(row, classes, strict=True)
            )
            lines.append(f"{begin}{cells}</tr>")
        return "\n".join([*lines, "</tbody>", "</table>"])

    def _texts(self) -> list[list[str]]:
        return [
            [_text(cell, column) for cell, column in zip(row, self.columns, strict=True)]
            for row in self.rows
        ]

    def _markdown_line(self, cells: list[str], widths: list[int]) -> str:
        padded = []
        for cell, column, width in zip(cells, self.columns, widths, strict=True):
            space = " " * (width - cell_len(cell))
            padded.append(cell + space if column.align is Align.LEFT else space + cell)
        return f"| {' | '.join(padded)} |"

    def _latex_cells(self, row: tuple[Cell, ...]) -> list[str]:
        cells = []
        for cell, column in zip(row, self.columns, strict=True):
            text = _text(cell, column)
            if text == NOTHING:
                cells.append("--")
            elif isinstance(cell, str):
                cells.append(_latex(text))
            else:  # a real minus, and no escape of the infinity sign
                cells.append(_latex(text.replace("inf", "∞").replace("-", _MINUS)))
        return cells


def _known(cell: Cell) -> bool:
    return cell is not None and not (isinstance(cell, Real) and math.isnan(cell))


def _text(cell: Cell, column: Column) -> str:
    """A cell as people read it."""
    if not _known(cell):
        return NOTHING
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Real) and not math.isfinite(cell):
        return "inf" if cell > 0 else "-inf"
    return format(cell, column.form)


def _csv(cell: Cell) -> str:
    if not _known(cell):
        return ""
    if isinstance(cell, str):
        return cell
    return str(int(cell)) if isinstance(cell, Integral) else repr(float(cell or 0.0))


# An underscore inside a word, as in `cross_area`, is no emphasis in GitHub's Markdown.
_MARKDOWN_SPECIAL = re.compile(r"[\\`*\[\]<>|~&$#]|(?<![^\W_])_|_(?![^\W_])")
_LINE_BREAK = re.compile(r"\r\n|\r|\n")


def _markdown(text: str) -> str:
    escaped = _MARKDOWN_SPECIAL.sub(lambda match: "\\" + match[0], text)
    return _LINE_BREAK.sub("<br>", escaped)


def _html_heading(column: Column) -> str:
    unit = f' <span class="unit">({escape(column.unit)})</span>' if column.unit else ""
    return escape(column.name) + unit


def _html_cell(text: str) -> str:
    # A real minus where a number begins with a hyphen; a lone one stands for what is not known.
    if text.startswith("-") and text[1:2].isdigit():
        text = _MINUS + text[1:]
    return _LINE_BREAK.sub("<br>", escape("\N{EN DASH}" if text == NOTHING else text))


_LATEX = str.maketrans(
    {
        "\\": r"\textbackslash{}",
        **{character: "\\" + character for character in "&%$#_{}"},
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "`": r"\textasciigrave{}",
        # A bracket or an asterisk behind the end of a row is an argument of it.
        "[": "{[}",
        "]": "{]}",
        "*": "{*}",
        "°": r"\textdegree{}",
        "²": r"\textsuperscript{2}",
        "³": r"\textsuperscript{3}",
        _MINUS: "$-$",
        "±": r"$\pm$",
        "\N{MULTIPLICATION SIGN}": r"$\times$",
        "≤": r"$\leq$",
        "≥": r"$\geq$",
        "∞": r"$\infty$",
        "τ": r"$\tau$",
        "→": r"$\rightarrow$",
    }
)


def _latex(text: str) -> str:
    # Two hyphens would become a dash.
    return _LINE_BREAK.sub(" ", text.replace("--", "-\0-").translate(_LATEX).replace("\0", "{}"))


def _latex_line(cells: list[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"
