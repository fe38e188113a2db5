"""The benchmark at toy size: all figures are there and fit together. No test asserts a time."""

import json

import numpy as np
import pytest
import torch
from fakes import FakeEnvironment

from imfvla.bench import main
from imfvla.benchmarks.latency import measure_latency
from imfvla.benchmarks.sizes import measure_size
from imfvla.benchmarks.tables import PARTS_OF_A_STEP as PARTS
from imfvla.benchmarks.tables import latency_table, speed_ratios
from imfvla.command.composition import compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.process.stopwatch import rate, times_ms
from imfvla.reporting.mapping import read_mapping
from imfvla.rollouts.threads import threads

TOY = (
    "observation.image_size=[32,32]", "core.width=16", "core.depth=1", "core.heads=2", "training.batch_size=2",
    "training.threads=1", "encoder.vision.channels=4", "encoder.vision.hidden=[8,8]",
)  # fmt: skip


@pytest.mark.parametrize("precision", ["fp32", "bf16"])
def test_the_last_line_has_all_figures(precision, capsys, monkeypatch):
    monkeypatch.setattr("imfvla.benchmarks.simulation.MEASURE_S", 0.02)
    monkeypatch.setattr("imfvla.benchmarks.simulation.FRAMES", 1)
    monkeypatch.setattr("imfvla.benchmarks.training.GEMM", 64)
    changes = (*TOY, "generator=imf_plain", f"training.precision={precision}")
    main(
        [
            "parts=[simulation,training,latency]", "at_scale=cpu",
            "experiments=[transfer_ph32_exec16]", "nfe=[1,3]", "training_steps=1", "latency_calls=5",
            "latency_warm_up=1", f"overrides=[{','.join(map(repr, changes))}]",
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
    for row in figures["latency"].values():
        assert row["of_parts"] > 0
        assert row["median_ms"] <= row["p95_ms"]
    assert all(value > 0 for value in figures["simulation"].values())
    assert printed["fingerprint"]["machine"]["cpu"]
    for text in ("physics steps", "demonstrations", "GFLOP/s", "one action chunk [ms]", "infer3"):
        assert text in out


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("latency_calls=0", "latency_calls must be between 1 and 1000000, found 0"),
        (
            "parts=[speed]",
            "parts must be one or more values, each one of sizes, simulation, training, latency, found ['speed']",
        ),
        ("at_scale=huge", "at_scale must be one of cpu, paper, found 'huge'"),
        ("sizes_of=some", "sizes_of must be all or a list of experiments, found 'some'"),
    ],
)
def test_a_wrong_value_is_named(override, message, capsys):
    with pytest.raises(SystemExit):
        main([override])
    assert message in capsys.readouterr().err


def test_sizes_are_printed_alone(capsys, monkeypatch):
    monkeypatch.setattr("imfvla.bench.SCALES", ("cpu",))
    main(["parts=[sizes]", "sizes_of=[socket_ddpm_ph16]"])
    printed = json.loads(capsys.readouterr().out.splitlines()[-1])
    size = printed["sizes"]["socket_ddpm_ph16"]["cpu"]
    assert list(size["chunk_gflop"]) == ["infer100"]
    assert "figures" not in printed


def test_flops_of_the_core_are_those_of_its_matrix_products():
    """Two action tokens of four steps and two of the times, which see each other and the prefix of nine."""
    config = compose("train", ["generator=ddpm", "core=standard", "horizon.pred=8", "horizon.exec=8", *TOY])
    size = measure_size(config, [1, 100])
    width, hidden, tokens, prefix = 16, 32, 2 + 2, 3 * 2 + 3
    time = 2 * 32 * width + width * width
    attention = tokens * width * (3 * width + 2 * (tokens + prefix) + width)
    products = 2 * (4 * 16) * width * 2 + 2 * time + attention + tokens * 3 * width * hidden
    assert size["core_evaluation_gflop"] == pytest.approx(2 * products / 1e9)
    gained = size["chunk_gflop"]["infer100"] - size["chunk_gflop"]["infer1"]
    assert gained == pytest.approx(99 * size["core_evaluation_gflop"])
    assert size["training_gflop_per_sample"] > 2 * size["chunk_gflop"]["infer1"]
    assert size["parameters"] == size["trained_parameters"]


@pytest.mark.parametrize("experiment", ["socket_act", "socket_smolvla", "transfer_native_dp"])
def test_every_kind_of_core_has_its_size_and_its_latency(experiment):
    seen = ("observation.image_size=[16,16]", "observation.views=[front,top]")
    config = compose("train", [f"+exp={experiment}", *seen, "core.width=20", "core.depth=2"])
    size = measure_size(config, [1])
    assert 0 < size["core_evaluation_gflop"] < size["chunk_gflop"]["infer1"]
    policy = build_unfitted(config)
    latency = measure_latency(FakeEnvironment(robot=policy.robot), policy, [1], calls=2, warm_up=1)
    assert latency["infer1"]["core_evaluation_ms"] > 0


def test_a_generator_that_has_no_single_step_is_measured_too():
    config = compose("train", ["generator=two_step", "horizon.pred=8", "horizon.exec=8", *TOY])
    size = measure_size(config, [2])
    assert set(size["chunk_gflop"]) == {"infer2"}
    policy = build_unfitted(config)
    latency = measure_latency(FakeEnvironment(robot=policy.robot), policy, [2], calls=2, warm_up=1)
    assert set(latency) == {"infer2"}


def test_a_sampler_that_wastes_time_is_reported():
    row = dict.fromkeys(
        ("median_ms", "p95_ms", "encoder_ms", "core_evaluation_ms", "overhead_ms", "of_parts"), 1.0
    )
    table = latency_table("x", {"infer1": row, "infer2": row | {"of_parts": 1.2}})
    assert "Limit 1.15: exceeded by infer2." in table.notes[0]


def test_speeds_are_compared_as_the_paper_s_table_3_does():
    latencies = {
        "socket_ph32_exec16": {
            "infer2": {"median_ms": 2.0, "log_error": 0.03},
            "infer3": {"median_ms": 3.0, "log_error": 0.0},
        },
        "socket_ddpm_ph16": {"infer100": {"median_ms": 50.0, "log_error": 0.04}},
    }
    ratios = speed_ratios(read_mapping().comparisons, latencies)
    assert {label: (row["ratio"], row["paper"]) for label, row in ratios.items()} == {
        "Socket iMF infer2 vs ph16 diffusion, Latency reduction": (25.0, "23.48×"),
        "Socket iMF infer3 vs ph16 diffusion, Inference FPS": (pytest.approx(50 / 3), "22.97×"),
    }
    latency = ratios["Socket iMF infer2 vs ph16 diffusion, Latency reduction"]
    assert np.log([latency["low"] / 25, latency["high"] / 25]) == pytest.approx([-1.96 * 0.05, 1.96 * 0.05])


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
