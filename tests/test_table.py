import csv
import io
import math
import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from nss_ros.table import Align, Column, Table

TABLE = Table(
    "Pairs of cross_area",
    (
        Column("area", align=Align.LEFT),
        Column("floor area", "m²", ",.0f"),
        Column("recall", "%", ".1f"),
        Column("pairs", form=","),
    ),
    (
        ("A", 1234.56, 32.94, 12_345),
        ("B", np.float64("nan"), float("inf"), np.int64(7)),
        ("mean", 617.0, -1.25, None),
    ),
    "OR >= 0.1",
)
TEXTS = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=12)
# One line each, as an editor shows them; nothing but what a text may hold.
ROWS = st.lists(st.tuples(TEXTS, st.floats(width=64) | st.integers()), max_size=4)


def two_columns(rows):
    columns = (Column("a|b", align=Align.LEFT), Column("x_1", "%", "g"))
    return Table("t", columns, tuple(rows))


def markdown_cells(line):
    cells = re.split(r"(?<!\\)(?:\\\\)*\|", line)[1:-1]
    return [re.sub(r"\\([!-/:-@\[-`{-~])", r"\1", cell.strip()) for cell in cells]


def console_text(table, width=200):
    console = Console(width=width, file=io.StringIO())
    console.print(table.to_rich())
    return console.file.getvalue()


def test_markdown_is_an_aligned_table_that_reads_as_text():
    assert TABLE.to_markdown() == (
        "**Pairs of cross_area**\n"
        "\n"
        "| area | floor area (m²) | recall (%) |  pairs |\n"
        "| ---- | --------------: | ---------: | -----: |\n"
        "| A    |           1,235 |       32.9 | 12,345 |\n"
        "| B    |               - |        inf |      7 |\n"
        "| mean |             617 |       -1.2 |      - |\n"
        "\n"
        "OR \\>= 0.1\n"
    )


def test_csv_holds_the_numbers_unrounded_and_leaves_unknown_ones_empty():
    assert TABLE.to_csv() == (
        "area,floor area (m²),recall (%),pairs\n"
        "A,1234.56,32.94,12345\n"
        "B,,inf,7\n"
        "mean,617.0,-1.25,\n"
    )


def test_latex_has_units_escapes_and_real_minus_signs():
    assert TABLE.to_latex() == "\n".join(
        [
            r"\begin{table}",
            r"  \centering",
            r"  \caption{Pairs of cross\_area. OR \textgreater{}= 0.1}",
            r"  \begin{tabular}{lrrr}",
            r"    \toprule",
            r"    area & floor area (m\textsuperscript{2}) & recall (\%) & pairs \\",
            r"    \midrule",
            r"    A & 1,235 & 32.9 & 12,345 \\",
            r"    B & -- & $\infty$ & 7 \\",
            r"    mean & 617 & $-$1.2 & -- \\",
            r"    \bottomrule",
            r"  \end{tabular}",
            r"\end{table}",
            "",
        ]
    )


def test_html_is_a_table_with_ids_and_escaped_texts():
    columns = (Column("a<b", align=Align.LEFT), Column("x", "%", ".1f"))
    table = Table("A & B", columns, (("<i>", -1.25), ("two\nlines", None)))
    assert table.to_html(["r1", "r2"]) == "\n".join(
        [
            "<table>",
            "<caption>A &amp; B</caption>",
            '<thead><tr><th scope="col">a&lt;b</th>'
            '<th scope="col" class="number">x <span class="unit">(%)</span></th></tr></thead>',
            "<tbody>",
            '<tr id="r1"><td>&lt;i&gt;</td><td class="number">\N{MINUS SIGN}1.2</td></tr>',
            '<tr id="r2"><td>two<br>lines</td><td class="number">\N{EN DASH}</td></tr>',
            "</tbody>",
            "</table>",
        ]
    )
    assert "id=" not in table.to_html()


def test_the_terminal_shows_the_same_texts():
    text = console_text(TABLE)
    for part in ("Pairs of cross_area", "(m²)", "1,235", "32.9", "12,345", "OR >= 0.1"):
        assert part in text
    assert re.search(r"B +- +inf +7\b", text)


def test_a_narrow_terminal_breaks_headings_but_no_cell():
    columns = (Column("method", align=Align.LEFT), Column("recall of different stages", "%"))
    table = Table("t", columns, (("fpfh_ransac", "20.0-35.1"),))
    text = console_text(table, width=28)
    assert re.search(r"fpfh_ransac +20\.0-35\.1", text)
    assert {"recall", "of", "different", "stages"} <= set(text.split())


def test_markup_of_rich_in_a_cell_is_text():
    assert "[red]A[/red]" in console_text(two_columns([("[red]A[/red]", 1.0)]))


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("a_b|*c*", r"a_b\|\*c\*"),
        ("_x_ <b>", r"\_x\_ \<b\>"),
        ("two\nlines", "two<br>lines"),
        ("[a](b) `c` \\", r"\[a\](b) \`c\` \\"),
    ],
)
def test_markdown_escapes_what_would_be_markup(text, escaped):
    assert f"| {escaped} " in two_columns([(text, 1.0)]).to_markdown()


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("50 % & $5_{x}^#~", r"50 \% \& \$5\_\{x\}\textasciicircum{}\#\textasciitilde{}"),
        (r"a\b", r"a\textbackslash{}b"),
        ("[x] *", "{[}x{]} {*}"),
        ("--seed", "-{}-seed"),
        ("two\nlines", "two lines"),
        ("≤ 0.2 °", r"$\leq$ 0.2 \textdegree{}"),
    ],
)
def test_latex_escapes_what_would_be_a_command(text, escaped):
    assert rf"    {escaped} & 1 \\" in two_columns([(text, 1.0)]).to_latex()


@given(ROWS)
def test_csv_parses_back(rows):
    read = list(csv.reader(io.StringIO(two_columns(rows).to_csv())))
    assert read[0] == ["a|b", "x_1 (%)"]
    assert len(read) == len(rows) + 1
    for (text, number), (text_read, number_read) in zip(rows, read[1:], strict=True):
        assert text_read == text
        if math.isnan(number):
            assert number_read == ""
        else:
            assert type(number)(number_read) == number


@given(ROWS)
def test_markdown_parses_back(rows):
    lines = two_columns(rows).to_markdown().splitlines()[2:]
    assert markdown_cells(lines[0]) == ["a|b", "x_1 (%)"]
    for (text, number), line in zip(rows, lines[2:], strict=True):
        text_read, number_read = markdown_cells(line)
        assert text_read == text
        expected = "-" if math.isnan(number) else format(number, "g")
        assert number_read == expected


def test_a_row_of_the_wrong_length_is_refused():
    with pytest.raises(ValueError, match="1 cells, 2 columns"):
        two_columns([("a",)])
