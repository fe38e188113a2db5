"""When `training.compile=auto` compiles, and that a run which began eagerly resumes as it would have gone on."""

import logging
from dataclasses import replace
from functools import partial

import pytest
import torch
from test_loop import Killed, StagedPolicy, assert_same_run, details_of, untimed_metrics
from tiny_policy import OPTIONS

from imfvla.nn.compiled import compile_loss, compile_parts
from imfvla.training import compiling
from imfvla.training.compiling import COMPILED, DECIDED_AT, EAGER, WORTH_S, Compiling
from imfvla.training.parallel import Alone

CPU = torch.device("cpu")


@pytest.fixture
def compiled(monkeypatch):
    """The policies that were compiled, in place of compiling them."""
    found = []
    monkeypatch.setattr(compiling, "compile_parts", lambda policy: found.append(policy))
    monkeypatch.setattr(compiling, "has_compiler", lambda: True)
    return found


def auto(steps=6000, before=None, device=CPU, **options):
    options = replace(OPTIONS, **{"steps": steps, "compile": "auto"} | options)
    return Compiling(options, "policy", device, Alone(), before)


def decided(steps, seconds, **options):
    """The mode after `DECIDED_AT` steps of so many seconds each."""
    choice = auto(steps, **options)
    for step in range(1, DECIDED_AT + 1):
        choice.took(seconds, step)
    return choice.mode


def test_auto_compiles_where_the_rest_takes_long(compiled):
    rest = 6000 - DECIDED_AT
    assert decided(6000, 1.01 * WORTH_S / rest) == COMPILED
    assert compiled == ["policy"]
    assert decided(6000, 0.99 * WORTH_S / rest) == EAGER
    assert decided(40, 1.0) == EAGER
    assert compiled == ["policy"]


def test_a_slow_step_among_the_first_does_not_decide(compiled):
    choice = auto()
    for step in range(1, DECIDED_AT + 1):
        choice.took(1000.0 if step == 1 else 0.01, step)
    assert choice.mode == EAGER


def test_nothing_is_decided_before_its_step(compiled):
    choice = auto()
    for step in range(1, DECIDED_AT):
        choice.took(10.0, step)
    assert choice.mode is None
    assert not compiled


def test_what_was_decided_or_is_wanted_stands(compiled):
    assert decided(6000, 0.0, before=COMPILED) == COMPILED
    assert decided(6000, 10.0, before=EAGER) == EAGER
    assert decided(40, 0.0, compile=True, before=EAGER) == COMPILED
    assert decided(6000, 10.0, compile=False, before=COMPILED) == EAGER
    assert compiled == ["policy", "policy"]


def test_auto_leaves_gpus_shards_and_machines_without_a_compiler_alone(compiled, monkeypatch):
    assert decided(6000, 10.0, sharding="full") == EAGER
    assert decided(6000, 10.0, device=torch.device("cuda")) == EAGER
    monkeypatch.setattr(compiling, "has_compiler", lambda: False)
    assert decided(6000, 10.0) == EAGER
    assert not compiled


@pytest.mark.parametrize("one_graph", [False, True], ids=["parts", "one graph"])
@pytest.mark.parametrize(("decided_at", "killed_at"), [(2, 1), (1, 3)])
def test_a_run_that_goes_on_compiled_resumes_bit_for_bit(
    tmp_path, make_trainer, monkeypatch, caplog, decided_at, killed_at, one_graph
):
    """Killed before the step that decides, and after it in the second stage, which other code computes."""
    monkeypatch.setattr(compiling, "compile_parts", partial(compile_parts, backend="aot_eager"))
    monkeypatch.setattr(compiling, "compile_loss", partial(compile_loss, backend="aot_eager"))
    monkeypatch.setattr(compiling, "ONE_GRAPH_ON", "cpu" if one_graph else "cuda")
    monkeypatch.setattr(compiling, "has_compiler", lambda: True)
    monkeypatch.setattr(compiling, "DECIDED_AT", decided_at)
    monkeypatch.setattr(compiling, "WORTH_S", 0.0)
    monkeypatch.setattr(compiling, "LINE_EVERY_S", 0.0)
    whole = make_trainer(tmp_path / "whole", StagedPolicy(), compile="auto")
    with caplog.at_level(logging.INFO):
        whole.train()
    assert "compiling: 1 parts in" in caplog.text
    assert details_of(whole.run.last_state)["compiling"] == COMPILED
    with pytest.raises(Killed):
        make_trainer(tmp_path / "resumed", StagedPolicy(dies_at=killed_at), compile="auto").train()
    resumed = make_trainer(tmp_path / "resumed", StagedPolicy(), compile="auto")
    assert resumed.step == killed_at
    resumed.train()
    assert resumed.compiling.is_one_graph == one_graph
    assert_same_run(whole.run, resumed.run)
    eager = make_trainer(tmp_path / "eager", StagedPolicy())
    eager.train()
    for row, expected in zip(untimed_metrics(whole.run), untimed_metrics(eager.run), strict=True):
        assert row == pytest.approx(expected, rel=1e-4)
    torch.compiler.reset()
