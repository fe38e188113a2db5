"""The page: sound HTML that needs no other file, and a way from every cell to the episodes behind it."""

import base64
import json
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import pytest
from synthetic_runs import answer_row

from imfvla.reporting.answers import Sources
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.media import Media
from imfvla.reporting.page import Picture, page
from imfvla.reporting.results import Result
from imfvla.reporting.table import Table
from imfvla.reporting.tables import row_table

MAPPING = read_mapping()
VOID = {"meta", "img", "br", "link"}
SVG = b'<svg xmlns="http://www.w3.org/2000/svg"><text>a figure</text></svg>'


class Reader(HTMLParser):
    """Tags in their nesting, attributes and texts; fails where a tag is not closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.texts: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open[-1:] not in (["style"], ["script"]):
            self.texts.append(data)

    def all(self, tag: str, attribute: str) -> list[str]:
        return [
            attributes[attribute] for name, attributes in self.tags if name == tag and attribute in attributes
        ]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("work")
    (root / "tables").mkdir()
    folder = answer_row(root / "runs", next(row for row in MAPPING.rows if row.name == "socket_flow_infer1"))
    (folder / "best_seed100004.mcap").write_bytes(b"")
    return root


@pytest.fixture(scope="module")
def reader(run) -> Reader:
    sources = Sources([run / "runs"])
    results = [Result.of(sources.answer(row, MAPPING)) for row in MAPPING.of_table("table1")]
    table = row_table("Table 1: socket peg insertion", results).shown
    return Reader(
        page(
            [table],
            [Picture("figure", 'A "figure" & more', SVG)],
            results,
            Media(run / "tables", is_copied=False),
        )
    )


def test_every_link_leads_somewhere(reader, run):
    links = reader.all("a", "href")
    ids = [attributes["id"] for _, attributes in reader.tags if "id" in attributes]
    assert len(set(ids)) == len(ids)
    inside = [link[1:] for link in links if link.startswith("#")]
    assert set(inside) <= set(ids)
    outside = [run / "tables" / unquote(link) for link in links if not link.startswith("#")]
    assert all(path.exists() for path in outside)
    names = {path.name for path in outside}
    assert {"config.yaml", "metrics.jsonl", "episodes.jsonl", "summary.json", "best_seed100004.mcap"} <= names
    assert any("generator=flow_high_noise" in str(path) for path in outside)


def test_each_row_of_ours_is_one_link_away_from_its_episodes(reader):
    targets = [link for link in reader.all("a", "href") if link.startswith("#row-")]
    assert targets == [f"#row-{row.name}" for row in MAPPING.of_table("table1")]
    text = " ".join(reader.texts)
    for seed in (100_000, 100_099):
        assert f"{seed}" in text
        assert f"{seed:016x}" in text
    assert "100 episodes" in text


def test_the_names_of_a_comparison_lead_to_its_two_rows(run):
    compared = Table("Compared", ("Comparison",), (("a < b vs c",),), keys=(("socket_l1", "socket_act"),))
    text = page([compared], [], [], Media(run, is_copied=False))
    assert '<a href="#row-socket_l1">a &lt; b</a> vs <a href="#row-socket_act">c</a>' in text


def test_a_missing_row_has_its_command(reader):
    text = "".join(reader.texts)
    assert "SmolVLA (100k), nfe 10: missing" in text
    assert "python -m imfvla.train +exp=socket_smolvla 'evaluation.nfe=[10]'" in text


def test_the_page_needs_no_other_file(reader):
    sources = reader.all("img", "src")
    assert len(sources) == 1
    kind, _, data = sources[0].partition(",")
    assert kind == "data:image/svg+xml;base64"
    assert ElementTree.fromstring(base64.b64decode(data)).tag.endswith("svg")
    assert reader.all("img", "alt") == ['A "figure" & more']
    assert not {tag for tag, _ in reader.tags} & {"iframe", "object"}
    assert not reader.all("script", "src")
    assert reader.all("link", "href") == ["data:,"]  # spares the browser looking for an icon
    assert not any(link.startswith(("http", "/")) for link in reader.all("a", "href"))


def test_names_from_files_are_text_not_markup(run):
    summary = next((run / "runs").rglob("summary.json"))
    found = json.loads(summary.read_text())
    found["fingerprint"]["machine"]["cpu"] = "<b>fast</b> & cheap"
    summary.write_text(json.dumps(found))
    sources = Sources([run / "runs"])
    results = [Result.of(sources.answer(row, MAPPING)) for row in MAPPING.of_table("table1")]
    table = Table("A <table>", ("a",), (("<i>",),), notes=("1 < 2",))
    reader = Reader(page([table], [], results, Media(run, is_copied=False)))
    assert not [tag for tag, _ in reader.tags if tag in ("b", "i")]
    assert any("<b>fast</b> & cheap" in text for text in reader.texts)
