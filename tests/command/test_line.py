"""What is typed reaches the config as it was meant, and nothing that Hydra offers is ignored without a word."""

import pytest
from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st

from imfvla.command.composition import compose
from imfvla.command.line import in_hydras_words, quoted, refuse_ignored
from imfvla.errors import UserError

ODD = ["ä b", "data (1)", "a=1,b=2", "it's", "x~", "a:b", "1", "1e3", "true", "c{d}", "[e]", "back\\slash\\"]


@settings(deadline=None)
@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_a_quoted_text_is_read_as_it_is(text):
    assert OverridesParser.create().parse_override(f"directory={quoted(text)}").value() == text


@pytest.mark.parametrize("path", ODD)
@pytest.mark.parametrize(
    ("command", "key"),
    [("gallery", "directory"), ("report", "output"), ("evaluate", "run"), ("train", "demos.directory")],
)
def test_a_path_is_taken_as_it_is_typed(command, key, path):
    config = compose(command, in_hydras_words([f"{key}={path}"]))
    for part in key.split("."):
        config = config[part]
    assert config == path


@pytest.mark.parametrize(
    ("typed", "key", "wanted"),
    [
        ("directory='a b'", "directory", "a b"),
        ("directories=[runs (1),x/seed=1]", "directories", ["runs (1)", "x/seed=1"]),
        ("directories=a b", "directories", ["a b"]),
        ("directories=['a,b',c]", "directories", ["a,b", "c"]),
        ("nfe=1,2", "nfe", [1, 2]),
        ("run=null", "run", None),
    ],
)
def test_what_is_written_as_hydra_wants_it_stays_so(typed, key, wanted):
    command = {"directory": "gallery", "directories": "report", "nfe": "evaluate", "run": "report"}[key]
    assert compose(command, in_hydras_words([typed]))[key] == wanted


def test_a_home_directory_is_that_of_shells(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    assert in_hydras_words(["directory=~/data"]) == ["directory=/home/me/data"]


def test_in_a_sweep_commas_are_choices_save_in_paths_that_are_there(tmp_path):
    assert in_hydras_words(["name=a,b", "nfe=1,2"], is_sweep=True) == ["name=a,b", "nfe=1,2"]
    there = tmp_path / "a,b=1"
    there.mkdir()
    assert in_hydras_words([f"run={there}"], is_sweep=True) == [f"run='{there}'"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--config-name", "other"], "--config-name is not supported: each command has one config"),
        (["--config-path", "/tmp"], "--config-path is not supported: name a folder of more configs"),
        (["--experimental-rerun", "config.pickle"], "--experimental-rerun is not supported"),
        (["--config-dir", "/nowhere"], "--config-dir /nowhere is not a directory"),
        (["-m", "--cfg", "job"], "-m and --cfg exclude each other"),
        (["--resolve"], "--resolve acts only with --cfg"),
        (["--package", "task"], "--package selects what --cfg shows"),
        (["hydra/launcher=submitit_local"], "hydra/launcher acts only in a sweep: add -m"),
        (["hydra.sweep.dir=x"], "hydra.sweep.dir acts only in a sweep: add -m"),
        (["-m", "hydra.run.dir=x"], "acts only outside of a sweep: with -m use hydra.sweep.dir"),
    ],
)
def test_what_would_be_ignored_is_refused_by_name(arguments, message):
    known = get_args_parser().parse_args(arguments)
    with pytest.raises(UserError, match=message):
        refuse_ignored(known, is_sweep=known.multirun)
