"""The benchmark at toy size: all figures are there and fit together. No test asserts a time."""

import json

import pytest
import torch

from imfvla.bench import main
from imfvla.benchmarks.clock import rate, threads, times_ms
from imfvla.benchmarks.training import PARTS

TOY = (
    "observation.image_size=[32,32]", "core.width=16", "core.depth=1", "core.heads=2", "training.batch_size=2",
    "training.threads=1", "encoder.vision.channels=4", "encoder.vision.hidden=[8,8]",
)  # fmt: skip


def test_the_last_line_has_all_figures(capsys, monkeypatch):
    monkeypatch.setattr("imfvla.benchmarks.simulation.MEASURE_S", 0.02)
    monkeypatch.setattr("imfvla.benchmarks.simulation.FRAMES", 1)
    monkeypatch.setattr("imfvla.benchmarks.training.GEMM", 64)
    main(
        [
            "experiments=[transfer_ph32_exec16]", "nfe=[1,3]", "training_steps=1", "latency_calls=5",
            "latency_warm_up=1", f"overrides=[{','.join(repr(text) for text in TOY)}]",
        ]
    )  # fmt: skip
    out = capsys.readouterr().out
    printed = json.loads(out.splitlines()[-1])
    figures = printed["figures"]["transfer_ph32_exec16"]
    training = figures["training"]
    assert sum(training[f"{part}_ms"] for part in PARTS) == pytest.approx(training["step_ms"])
    assert all(training[f"{part}_ms"] > 0 for part in PARTS)
    assert training["samples_per_s"] == pytest.approx(2e3 / training["step_ms"])
    assert training["share_of_peak"] == pytest.approx(training["achieved_gflops"] / training["peak_gflops"])
    assert set(figures["latency"]) == {"infer1", "infer3"}
    assert all(value > 0 for value in figures["simulation"].values())
    assert printed["fingerprint"]["machine"]["cpu"]
    for text in ("physics steps", "demonstrations", "GFLOP/s", "one action chunk [ms]", "infer3"):
        assert text in out


def test_a_wrong_number_is_named(capsys):
    with pytest.raises(SystemExit):
        main(["latency_calls=0"])
    assert "latency_calls must be a whole number of at least 1, found 0" in capsys.readouterr().err


def test_functions_are_timed_in_turn_after_the_warm_up():
    called: list[str] = []
    taken = times_ms([lambda: called.append("a"), lambda: called.append("b")], calls=2, warm_up=1)
    assert taken.shape == (2, 2)
    assert (taken >= 0).all()
    assert called == ["a", "b"] * 3


def test_a_rate_counts_calls():
    assert rate(lambda: None, seconds=0.001) > 0


def test_the_number_of_threads_is_put_back():
    before = torch.get_num_threads()
    with threads(before + 1):
        assert torch.get_num_threads() == before + 1
    assert torch.get_num_threads() == before
