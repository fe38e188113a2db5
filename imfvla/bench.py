"""python -m imfvla.bench: speed of simulation, rendering, demonstrations, training and inference on this machine."""

import json
import logging
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.core.global_hydra import GlobalHydra

from imfvla.composition import compose
from imfvla.entry import entry_point
from imfvla.fingerprint import fingerprint
from imfvla.options import require
from imfvla.reporting.table import Table, number

log = logging.getLogger(__name__)


@entry_point("bench")
def main(config: dict[str, Any]) -> None:
    """Prints one table for each experiment, and all figures as one line of JSON, which comes last."""
    for key in ("training_steps", "latency_calls", "latency_warm_up"):
        require(
            isinstance(config[key], int) and config[key] >= 1,
            key,
            "a whole number of at least 1",
            config[key],
        )
    figures = {}
    GlobalHydra.instance().clear()  # the experiments are composed below
    for experiment in config["experiments"]:
        composed = compose("train", [f"+exp={experiment}", f"scale={config['scale']}", *config["overrides"]])
        log.info("measuring %s at scale %s", experiment, config["scale"])
        with tempfile.TemporaryDirectory() as scratch:
            figures[experiment] = measure(composed, config, Path(scratch))
        for table in tables_of(experiment, figures[experiment]):
            table.print()
    print(json.dumps({**config, "figures": figures, "fingerprint": fingerprint()}))


def measure(composed: Mapping[str, Any], config: Mapping[str, Any], scratch: Path) -> dict[str, Any]:
    """All figures of one experiment."""
    import torch  # here, since imports take seconds and slips in the config are told before

    from imfvla.benchmarks.clock import threads
    from imfvla.benchmarks.latency import measure_latency
    from imfvla.benchmarks.simulation import make_environment, measure_demonstrations, measure_simulation
    from imfvla.benchmarks.training import measure_training
    from imfvla.policy import build_policy
    from imfvla.training.data import prepare_windows

    env = make_environment(composed)
    simulation = measure_simulation(env)
    demonstrating, demonstrations = measure_demonstrations(composed, scratch)
    torch.manual_seed(0)
    policy = build_policy(composed, prepare_windows(composed, demonstrations).statistics())
    with threads(torch.get_num_threads()):
        training = measure_training(
            composed, policy, demonstrations, scratch / "run", config["training_steps"]
        )
    latency = measure_latency(
        env, policy.eval(), config["nfe"], calls=config["latency_calls"], warm_up=config["latency_warm_up"]
    )
    return {
        "parameters": sum(parameter.numel() for parameter in policy.parameters()),
        "simulation": simulation | demonstrating,
        "training": training,
        "latency": latency,
    }


def tables_of(experiment: str, figures: Mapping[str, Any]) -> list[Table]:
    """The figures of one experiment for people."""
    simulation, training = figures["simulation"], figures["training"]
    speed = (
        ("physics steps", number(simulation["physics_steps_per_s"], 0), "1/s, one process"),
        ("control steps", number(simulation["control_steps_per_s"], 0), "1/s, one process, not rendered"),
        ("rendered view", number(simulation["ms_per_view"], 2), "ms"),
        ("demonstrations", number(simulation["demonstrations_per_min"], 1), "1/min, one process, recorded"),
        ("training samples", number(training["samples_per_s"], 1), "1/s"),
        ("training step", number(training["step_ms"], 1), f"ms, batch {training['batch_size']}"),
        *(
            (
                f"  {part}",
                number(training[f"{part}_ms"], 1),
                f"ms, {training[f'{part}_ms'] / training['step_ms']:.0%}",
            )
            for part in ("data", "encoder", "core", "jvp", "backward", "optimiser")
        ),
        (
            "  achieved",
            number(training["achieved_gflops"], 1),
            f"GFLOP/s, {training['gflop_per_step']:.1f} a step",
        ),
        (
            "  peak",
            number(training["peak_gflops"], 1),
            f"GFLOP/s, {training['precision']} matrix product, {training['threads']} thread(s); "
            f"achieved {training['share_of_peak']:.0%}",
        ),
    )
    names = ("median_ms", "p95_ms", "encoder_ms", "core_evaluation_ms", "overhead_ms")
    latency = tuple(
        (name, *(number(row[key], 3) for key in names)) for name, row in figures["latency"].items()
    )
    parameters = f"{figures['parameters'] / 1e6:.2f} M parameters"
    return [
        Table(f"{experiment}, {parameters}", ("What", "Value", "Unit"), speed),
        Table(
            f"{experiment}: one action chunk [ms], batch 1, one thread, numpy to numpy",
            ("sampler", "median", "p95", "encoder", "core evaluation", "overhead"),
            latency,
        ),
    ]


if __name__ == "__main__":
    main()
