"""The measurements of `imfvla.bench` as tables for people."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

from imfvla.reporting.mapping.comparisons import Comparison
from imfvla.reporting.table import Table, number

SAME_STEP = {"generator=imf_plain"}  # overrides that leave the network and its steps as they are
PARTS_OF_A_STEP = ("data", "encoder", "core", "jvp", "backward", "optimiser")
MOST_OF_PARTS = 1.15  # a chunk may cost this multiple of its encoder and calls of the core
NORMAL_95 = 1.96  # half a 95% interval in standard errors
SPEEDS = ("inference_ms_mean", "inference_fps")  # comparisons of Table 3 that follow from times of a chunk


def size_table(rows: Sequence[tuple[str, str, Mapping[str, Any]]]) -> Table:
    """Of experiments at scales, with the result of `measure_size` each."""
    columns = ("experiment", "scale", "parameters [M]", "trained [M]", "encoder", "core, 1 NFE", "chunk")
    cells = tuple(
        (
            experiment,
            scale,
            *(number(size[key] / 1e6, 2) for key in ("parameters", "trained_parameters")),
            *(number(size[f"{part}_gflop"], 3) for part in ("encoder", "core_evaluation")),
            ", ".join(f"{name} {number(value, 3)}" for name, value in size["chunk_gflop"].items()),
            number(size["training_gflop_per_sample"], 3),
        )
        for experiment, scale, size in rows
    )
    title = "Parameters, and GFLOP of matrix products and convolutions at batch 1"
    return Table(title, (*columns, "training sample"), cells)


def simulation_rows(figures: Mapping[str, float]) -> tuple[tuple[str, str, str], ...]:
    """Name, value and unit of the rates of the simulation that were measured."""
    rates = (
        ("physics_steps_per_s", "physics steps", 0, "1/s, one process"),
        ("control_steps_per_s", "control steps", 0, "1/s, one process, not rendered"),
        ("ms_per_view", "rendered view", 2, "ms"),
        ("demonstrations_per_min", "demonstrations", 1, "1/min, one process, recorded"),
        ("forcing_percent", "  forced to disk", 3, "% of their time"),
    )
    return tuple(
        (what, number(figures[key], digits), unit) for key, what, digits, unit in rates if key in figures
    )


def training_rows(figures: Mapping[str, Any]) -> tuple[tuple[str, str, str], ...]:
    """Name, value and unit of a training step and its parts."""
    return (
        ("training samples", number(figures["samples_per_s"], 1), "1/s"),
        ("training step", number(figures["step_ms"], 1), f"ms, batch {figures['batch_size']}"),
        *(
            (
                f"  {part}",
                number(figures[f"{part}_ms"], 1),
                f"ms, {figures[f'{part}_ms'] / figures['step_ms']:.0%}",
            )
            for part in PARTS_OF_A_STEP
        ),
        (
            "  achieved",
            number(figures["achieved_gflops"], 1),
            f"GFLOP/s, {figures['gflop_per_step']:.1f} a step",
        ),
        (
            "  peak",
            number(figures["peak_gflops"], 1),
            f"GFLOP/s, {figures['precision']} matrix product, {figures['threads']} thread(s); "
            f"achieved {figures['share_of_peak']:.0%}",
        ),
        ("saving state and weights", number(figures["saving_ms"], 1), "ms"),
        (
            "  forced to disk",
            number(figures["forcing_ms"], 1),
            f"ms, {figures['forcing_share']:.4%} of training",
        ),
    )


def latency_table(experiment: str, figures: Mapping[str, Mapping[str, float]]) -> Table:
    """Of the samplers of an experiment."""
    names = ("median_ms", "p95_ms", "encoder_ms", "core_evaluation_ms", "overhead_ms", "of_parts")
    rows = tuple((sampler, *(number(row[key], 3) for key in names)) for sampler, row in figures.items())
    over = [sampler for sampler, row in figures.items() if row["of_parts"] > MOST_OF_PARTS]
    verdict = f"exceeded by {', '.join(over)}" if over else "kept by all"
    return Table(
        f"{experiment}: one action chunk [ms], batch 1, one thread, numpy to numpy",
        ("sampler", "median", "p95", "encoder", "core, 1 NFE", "overhead", "over parts"),
        rows,
        (f"Over parts: chunk / (encoder + NFE x core). Limit {MOST_OF_PARTS}: {verdict}.",),
    )


def speed_ratios(
    comparisons: Sequence[Comparison], latencies: Mapping[str, Mapping[str, Mapping[str, float]]]
) -> dict[str, dict[str, float | str]]:
    """By printed comparison of Table 3: median times of both chunks [ms], their ratio with interval, the paper's.

    `latencies` are of the experiments in conf/exp without overrides; rows whose overrides change what is computed in a
    step are left out.
    """
    found: dict[str, dict[str, float | str]] = {}
    for comparison in comparisons:
        times = [
            latencies.get(row.experiment, {}).get(f"infer{row.nfe}")
            for row in (comparison.baseline, comparison.row)
            if set(row.overrides) <= SAME_STEP
        ]
        if comparison.paper and comparison.of in SPEEDS and len(times) == 2 and all(times):
            slow, fast = (time["median_ms"] for time in times if time)
            factor = math.exp(NORMAL_95 * math.hypot(*(time["log_error"] for time in times if time)))
            found[comparison.paper.label] = {
                "baseline_ms": slow, "ms": fast, "ratio": slow / fast, "low": slow / fast / factor,
                "high": slow / fast * factor, "paper": comparison.paper.result,
            }  # fmt: skip
    return found


def speed_table(ratios: Mapping[str, Mapping[str, Any]]) -> Table:
    """The result of `speed_ratios`."""
    return Table(
        "Speed of one chunk beside the paper's Table 3",
        ("comparison", "baseline [ms]", "ours [ms]", "ratio (95%)", "paper"),
        tuple(
            (
                label,
                number(row["baseline_ms"], 2),
                number(row["ms"], 2),
                f"{number(row['ratio'], 2)}× ({number(row['low'], 2)}-{number(row['high'], 2)})",
                row["paper"],
            )
            for label, row in ratios.items()
        ),
    )
