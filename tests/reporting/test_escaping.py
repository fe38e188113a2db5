"""Hostile names in every format that is published: they are shown, and do nothing."""

import csv
import io
import json
import os
import re
import shutil
import subprocess
import warnings
from html.parser import HTMLParser
from itertools import pairwise
from urllib.parse import unquote_to_bytes
from xml.etree import ElementTree

import pytest
from rich.console import Console

from imfvla.figures.style import new_figure, render, style
from imfvla.process.visible import visible
from imfvla.reporting.escaping import (
    csv_cell,
    html_json,
    html_text,
    latex_cell,
    latex_text,
    markdown_cell,
    markdown_code,
    markdown_text,
)
from imfvla.reporting.media import Media
from imfvla.reporting.page import Picture, page
from imfvla.reporting.page_rows import anchor
from imfvla.reporting.table import Table

NAMES = {
    "escape sequence": "\x1b]0;owned\x07\x1b[31mred",
    "bidirectional": "\u202egpj.exe\u2066",
    "surrogate": "bad\udcff",
    "lines": "a\nb\r\n\n# c\u2028d",
    "formula": '=HYPERLINK("https://example.org?"&A1,"x")',
    "command": "-2+3+cmd|' /C calc'!A0",
    "sum": "@SUM(1+9)*cmd|'!A0",
    "tab": "\t=1+1",
    "html": '<img src=x onerror="alert(1)"><script>alert(2)</script><!-- ',
    "attribute": "\" onmouseover='alert(1)' x=\"",
    "entity": "&lt;b&gt; &#60;",
    "markdown": "![x](https://example.org/p.png) [a][b] [c]: d `e` *f* _g_ | h \\| i \\",
    "backticks": "``` ` ``",
    "latex": r"\input{/etc/passwd} $x_1^2$ % # & ~ {} \\[1cm] ^^M ?` <>|",
    "bracket": "[3cm] * first",
    "star": "*",
    "foreign": "你好 é ñ ű ç π₀ 🙂 ß “a” µ ± –",
    "mathtext": r"$\frac{ $",
}
HOSTILE = pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)


def table_of(names) -> Table:
    names = tuple(names)
    rows = tuple((name, f"{place}.00 [1.00, 2.00]", name) for place, name in enumerate(names))
    return Table(
        names[0], ("Row", "Value", names[-1]), rows, names, ((),) * len(rows), ((names[0], names[1]),)
    )


@HOSTILE
def test_terminal(name):
    console = Console(record=True, width=200, file=io.StringIO())
    table_of([name, name]).print(console)
    text = console.export_text()
    assert text.isascii() or name == NAMES["foreign"]
    assert all(line.isprintable() for line in text.split("\n"))


@HOSTILE
def test_csv(name):
    rows = list(csv.reader(io.StringIO(table_of([name, name]).csv())))
    assert [len(row) for row in rows] == [3, 3, 3]
    for cell in (cell for row in rows for cell in row):
        assert cell.isprintable()
        assert not cell.startswith(("=", "+", "-", "@", "\t", "\r"))
        assert not re.search(r"[\x00-\x1f]", cell)


@pytest.mark.parametrize(
    "cell",
    [
        "-3.2",
        "+15",
        "-1e-05",
        "-",
        "-1 [-7.7, +5.6]",
        "-2.0 [-12.5, 8.5] points",
        "-0.5 ms",
        "1.76×",
        "missing",
        "",
    ],
)
def test_numbers_in_csv_stay(cell):
    assert list(csv.reader(io.StringIO(Table("", ("a", "b"), ((cell, "x"),)).csv())))[1] == [cell, "x"]


def test_text_that_begins_as_a_formula_has_an_apostrophe():
    assert csv_cell("=1+1") == "'=1+1"
    assert csv_cell("-x") == "'-x"
    assert csv_cell("+1;=2") == "'+1;=2"
    assert csv_cell("＝1") == "'＝1"
    assert csv_cell("a=1") == "a=1"


@HOSTILE
def test_markdown(name):
    text = table_of([name, name]).markdown()
    lines = text.split("\n")
    assert len(lines) == 15
    assert all(line.isprintable() for line in lines)
    for line in lines[2:6]:
        assert len(re.findall(r"(?<!\\)(?:\\\\)*\|", line)) == 4, line
    for line in [*lines[:6], lines[7], lines[9]]:  # all but the commands, which are code
        assert not re.search(r"<[A-Za-z/!?]|&(?!lt;|amp;)#?\w+;|(?<!\\)(?:\\\\)*[`*]", line), line
        assert not re.search(r"(?<!\\)(?:\\\\)*\][(\[:]", line), line


@HOSTILE
def test_a_markdown_reader_finds_the_name_and_no_markup(name):
    reader = pytest.importorskip("markdown_it").MarkdownIt("commonmark").enable("table")
    tokens = [
        child for token in reader.parse(table_of([name, name]).markdown()) for child in token.children or ()
    ]
    assert {token.type for token in tokens} <= {"text", "text_special", "code_inline"}
    commands = [token.content for token in tokens if token.type == "code_inline"]
    assert commands == [visible(name)]
    texts = [
        "".join(child.content for child in token.children)
        for token in reader.parse(table_of([name, name]).markdown())
        if token.type == "inline"
    ]
    assert texts[0] == texts[1 + 2] == visible(name).strip()


def test_markdown_by_hand():
    assert markdown_text("1.23 [1.06, 1.42], socket_ph32 <0.001 a < b & c") == (
        "1.23 [1.06, 1.42], socket_ph32 <0.001 a < b & c"
    )
    assert markdown_text("<b>&lt;") == "&lt;b>&amp;lt;"
    assert markdown_text("_a_ b_c *d* `e` \\") == r"\_a\_ b_c \*d\* \`e\` \\"
    assert markdown_text("![a](b)") == r"![a\](b)"
    assert markdown_cell(r"a|b\|c") == r"a\|b\\\|c"
    assert markdown_code("a") == "`a`"
    assert markdown_code("a`b``c") == "``` a`b``c ```"
    assert markdown_code("a\nb") == r"`a\nb`"


@HOSTILE
def test_latex_is_ascii_and_has_no_command_of_others(name):
    text = table_of([name, name]).latex()
    assert text.isascii()
    assert r"\input" not in text
    body = text[text.index(r"\toprule") : text.index(r"\bottomrule")].split("\n")
    assert len(body) == 6
    assert not any(line.startswith(("[", "*")) for line in body)


def test_latex_by_hand():
    assert latex_text("50% of a_b & {c} #1 $") == r"50\% of a\_b \& \{c\} \#1 \$"
    assert latex_text("é ñ ű π 你") == r"\'{e} \~{n} \H{u} $\pi$ U+4F60"
    assert latex_text("e\u0301") == latex_text("é")
    assert latex_text("a\nb") == r"a\textbackslash{}nb"
    assert latex_cell("[a]") == "{}[a]"
    assert latex_cell("1.25 [1.00, 1.50]") == "1.25 [1.00, 1.50]"


def test_latex_compiles(tmp_path):
    engine = next(filter(shutil.which, ("pdflatex", "tectonic")), None)
    if engine is None:
        pytest.skip("needs pdflatex (Debian: texlive-latex-recommended) or tectonic")
    table = table_of(NAMES.values())
    (tmp_path / "table.tex").write_text(table.latex(), encoding="utf-8")
    (tmp_path / "paper.tex").write_text(
        "\\documentclass{article}\n\\usepackage{booktabs,graphicx}\n\\begin{document}\n\\input{table}\n\\end{document}\n",
        encoding="utf-8",
    )
    flags = ["-halt-on-error", "-interaction=nonstopmode", "-no-shell-escape"] if engine == "pdflatex" else []
    done = subprocess.run(
        [engine, *flags, "paper.tex"], cwd=tmp_path, capture_output=True, text=True, check=False, timeout=120,
        encoding="utf-8", errors="replace",
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]
    assert (tmp_path / "paper.pdf").stat().st_size > 1000


class Reader(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.found: list = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.found.append((tag, attrs))

    def handle_data(self, data):
        self.found.append(data)

    def handle_comment(self, data):
        self.found.append(("comment", data))


@HOSTILE
def test_html(name):
    shown = html_text(name)
    assert not re.search("[\x00-\x1f]", shown)
    (tag, attributes), text = Reader(f'<b title="{shown}">{shown}</b>').found
    assert tag == "b"
    assert attributes == [("title", text)]


@HOSTILE
def test_page(name, tmp_path):
    svg = b'<svg xmlns="http://www.w3.org/2000/svg"/>'
    text = page([table_of([name, name])], [Picture(name, name, svg)], [], Media(tmp_path, is_copied=False))
    found = Reader(text).found
    tags = [(tag, dict(attributes)) for tag, attributes in (one for one in found if isinstance(one, tuple))]
    assert "comment" not in {tag for tag, _ in tags}
    assert [tag for tag, _ in tags].count("script") == 2
    assert [tag for tag, _ in tags].count("img") == 1
    assert not {attribute for _, attributes in tags for attribute in attributes if attribute.startswith("on")}
    assert {attributes["href"][:1] for tag, attributes in tags if tag == "a"} == {"#"}
    titles = [after for before, after in pairwise(found) if before and before[0] == "figcaption"]
    assert titles == [visible(name)]


@HOSTILE
def test_links(name, tmp_path):
    if "/" in name or "\0" in name:
        pytest.skip("no name of a file")
    file = tmp_path / name
    file.touch()
    link = Media(tmp_path, is_copied=False).link(file, tmp_path)
    assert re.fullmatch(r"[A-Za-z0-9_.~%-]+", link)
    assert os.fsdecode(unquote_to_bytes(link)) == name
    ((tag, attributes), shown) = Reader(anchor(file, tmp_path, Media(tmp_path, is_copied=False))).found
    assert (tag, dict(attributes), shown) == ("a", {"href": link}, visible(name))


@HOSTILE
def test_figure(name):
    with style():
        figure = new_figure(3, 2)
        axes = figure.add_subplot(title=name, xlabel=name)
        axes.plot([1, 2], label=name)
        axes.legend()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of signs that the font lacks
        svg = render(figure)[".svg"]
    assert ElementTree.fromstring(svg).tag.endswith("svg")
    assert axes.get_title(loc="left") == visible(name, keep="\n")


@HOSTILE
def test_json_in_a_script_element(name):
    text = html_json({name: [name]})
    assert json.loads(text) == {name: [name]}
    assert "<" not in text
    assert text.isascii()
