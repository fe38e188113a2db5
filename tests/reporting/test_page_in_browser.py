"""The whole page as Chromium shows it; runs where Chromium is installed."""

import json
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from chromium import BINARY, Page, chromium
from synthetic_runs import answer_row

from imfvla.command.composition import compose
from imfvla.command.publication import publish
from imfvla.recording.video import write_mp4
from imfvla.reporting.mapping import read_mapping

pytestmark = pytest.mark.skipif(BINARY is None, reason="chromium is not installed")
MAPPING = read_mapping()
ROWS = {row.name: row for row in MAPPING.rows}
WIDTHS = (400, 1000, 1400)
TABLE_1 = "document.querySelector('#table-1 + .scroll table')"


def record(folder: Path, seeds: tuple[int, ...]) -> None:
    """Adds videos of a square that moves, and MCAP files that nobody reads, to an evaluation."""
    recordings = {}
    for label, seed in zip(("best", "median", "worst"), seeds, strict=True):
        name = f"{label}_seed{seed}"
        frames = np.zeros((10, 80, 240, 3), np.uint8)
        for number, frame in enumerate(frames):
            frame[20:60, 20 * number : 20 * number + 40] = (230, 159, 0)
        write_mp4(folder / f"{name}.mp4", frames, 25)
        (folder / f"{name}.mcap").write_bytes(b"mcap")
        recordings[label] = {"seed": seed, "return": 100.0 + seed % 7, "file": f"{name}.mcap"}
    path = folder / "summary.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"recordings": recordings}))


@pytest.fixture(scope="module")
def page_file(tmp_path_factory) -> Path:
    """A report whose runs are gone: it needs nothing but its media folder."""
    root = tmp_path_factory.mktemp("report")
    for index, name in enumerate(("socket_infer1", "socket_infer2", "socket_ddpm_ph32", "transfer_infer1")):
        folder = answer_row(root / "runs", ROWS[name], quality=0.4 + 0.1 * index)
        record(folder, (100_004, 100_020, 100_077))
    method = compose("train", ["+exp=socket_ph32_exec16"])
    publish([root / "runs"], root / "report", MAPPING, method, media=True).write()
    (root / "runs").rename(root / "moved")
    return root / "report" / "index.html"


@pytest.fixture(scope="module")
def tab(tmp_path_factory) -> Page:
    with chromium(tmp_path_factory.mktemp("profile")) as page:
        yield page


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_overflows_and_the_console_is_silent(tab, page_file, width):
    tab.open(page_file, width)
    tab.run("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
    assert tab.run("document.documentElement.scrollWidth") <= width
    outside = tab.run(
        "[...document.querySelectorAll('body *')].filter((element) => !element.closest('.scroll')"
        " && element.getBoundingClientRect().right > innerWidth + 1).map((element) => element.outerHTML.slice(0, 80))"
    )
    assert outside == []
    assert tab.errors == []


@pytest.mark.parametrize("width", WIDTHS[1:])
def test_latency_and_rates_are_seen_without_scrolling(tab, page_file, width):
    tab.open(page_file, width)
    heads = tab.run(
        "[...document.querySelectorAll('table.sortable th')].map((head) =>"
        " [head.textContent, head.getBoundingClientRect().right"
        " - head.closest('.scroll').getBoundingClientRect().right])"
    )
    ends = [end for name, end in heads if name in ("Latency ms", "Inf. FPS", "Control FPS")]
    assert len(ends) == 3 * 3  # of Tables 1 and 2 and the evaluations in neither
    assert max(ends) <= 1


def test_the_names_of_rows_stay_where_a_narrow_page_is_scrolled(tab, page_file):
    tab.open(page_file, 400)
    place = "document.querySelector('table.sortable tbody td').getBoundingClientRect().left"
    before = tab.run(place)
    after = tab.run(f"document.querySelector('.scroll').scrollLeft = 300; {place}")
    assert after == before


def test_every_video_plays_and_every_link_leads_into_the_folder(tab, page_file):
    tab.open(page_file, 1400)
    tab.run("document.querySelectorAll('details').forEach((details) => { details.open = true; })")
    played = tab.run(
        "Promise.all([...document.querySelectorAll('video')].map((video) => new Promise((done) => {"
        " video.onended = () => done(video.videoWidth); video.onerror = () => done(video.error.message);"
        " video.play(); })))"
    )
    assert played == [240] * (3 * 4)
    links = tab.run("[...document.querySelectorAll('a')].map((link) => link.getAttribute('href'))")
    files = {unquote(link) for link in links if not link.startswith("#")}
    assert all(link.startswith("media/") and (page_file.parent / link).is_file() for link in files)
    assert sum(link.endswith(".mcap") for link in files) == 3 * 4
    assert tab.errors == []


def test_tables_sort_by_any_column_and_missing_values_stay_last(tab, page_file):
    tab.open(page_file, 1400)
    column = f"[...{TABLE_1}.tBodies[0].rows].map((row) => row.cells[4].textContent)"
    button = f"{TABLE_1}.tHead.rows[0].cells[4].querySelector('button').click()"
    first = tab.run(f"{button}; {column}")
    again = tab.run(f"{button}; {column}")
    for texts, is_descending in ((first, True), (again, False)):
        numbers = [float(text.split()[0]) for text in texts if text not in ("missing", "-")]
        assert len(numbers) == 10
        assert numbers == sorted(numbers, reverse=is_descending)
        assert set(texts[len(numbers) :]) == {"missing"}


def test_two_rows_differ_in_what_their_configs_differ_in(tab, page_file):
    tab.open(page_file, 1400)
    rows = "[...document.querySelectorAll('#differences tbody tr')]"
    texts = f"{rows}.map((row) => [...row.cells].map((cell) => cell.textContent))"
    choose = (
        "(() => { const [one, other] = ['one', 'other'].map((name) => document.getElementById(`differ-${name}`));"
        " one.value = '%s'; other.value = '%s'; one.dispatchEvent(new Event('change')); return %s; })()"
    )
    found = {key: values for key, *values in tab.run(choose % ("socket_infer2", "socket_ddpm_ph32", texts))}
    assert found["name"] == ['"socket_ph32_exec16"', '"socket_ddpm_ph32_exec16"']
    assert found["evaluated: nfe"] == ["2", "100"]
    assert "evaluated: task" not in found
    assert tab.run(choose % ("socket_infer2", "socket_infer2", texts)) == []
    assert tab.run("document.getElementById('no-difference').hidden") is False
