"""python -m imfvla.bench: speed of simulation, rendering, demonstrations, training and inference on this machine."""

from imfvla.command import begin

if __name__ == "__main__":
    begin()

import json
import logging
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated, Any

from hydra.core.global_hydra import GlobalHydra

from imfvla.benchmarks.tables import (
    latency_table,
    simulation_rows,
    size_table,
    speed_ratios,
    speed_table,
    training_rows,
)
from imfvla.command.composition import Places, choices_of, compose
from imfvla.command.entry import entry_point
from imfvla.options import at_least, build, one_of, require, some, within
from imfvla.process.progress import Progress
from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.table import Table, number
from imfvla.storage.fingerprint import fingerprint

PARTS = ("sizes", "simulation", "training", "latency")
SCALES = ("cpu", "paper")
MANY = 1_000_000
log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """conf/bench.yaml."""

    parts: Annotated[tuple[str, ...], some(one_of(*PARTS))]
    sizes_of: Any
    experiments: Any
    at_scale: Annotated[str, one_of(*SCALES)]
    overrides: tuple[str, ...]
    nfe: Annotated[tuple[int, ...], some(at_least(1))] | None
    training_steps: Annotated[int, within(1, MANY)]
    latency_calls: Annotated[int, within(1, MANY)]
    latency_warm_up: Annotated[int, within(1, MANY)]


@entry_point("bench")
def main(config: dict[str, Any]) -> None:
    """Prints the tables of the requested parts, then all figures as one line of JSON."""
    build(BenchOptions, config, "")
    parts, places = config["parts"], Places.of_command()
    GlobalHydra.instance().clear()  # the experiments are composed below
    result: dict[str, Any] = {}
    counted = experiments(config["sizes_of"], "sizes_of", places) if "sizes" in parts else []
    measured = experiments(config["experiments"], "experiments", places) if set(parts) != {"sizes"} else []
    # Composed here, so that a wrong name is reported before anything is measured.
    composed = [of_measured(name, config, places) for name in measured]
    for experiment in counted:
        compose("train", [f"+exp={experiment}"], places)
    if counted:
        result["sizes"] = sizes(counted, config, places)
    if measured:
        figures = map(lambda name, of_name: measure_and_print(name, of_name, config), measured, composed)
        result["figures"] = dict(zip(measured, figures, strict=True))
    if "latency" in parts and not config["overrides"]:
        latencies = {name: figures["latency"] for name, figures in result["figures"].items()}
        result["ratios"] = speed_ratios(read_mapping().comparisons, latencies)
        if result["ratios"]:
            speed_table(result["ratios"]).print()
    print(json.dumps({**config, **result, "fingerprint": fingerprint()}))


def experiments(wanted: Any, key: str, places: Places) -> list[str]:
    """Names of files in exp/ of `conf` and of these places: those in the list `wanted`, or all of them."""
    if wanted == "all":
        return choices_of("exp", "train", places)
    is_list = isinstance(wanted, list) and bool(wanted) and all(isinstance(name, str) for name in wanted)
    require(is_list, key, "all or a list of experiments", wanted)
    return wanted


def sizes(names: Sequence[str], config: Mapping[str, Any], places: Places) -> dict[str, Any]:
    """Prints the table of sizes and returns its figures, by experiment and scale."""
    from imfvla.benchmarks.sizes import measure_size  # here, since imports take seconds

    found: dict[str, dict[str, Any]] = {}
    with Progress("sizes", len(names) * len(SCALES)) as bar:
        for name, scale in product(names, SCALES):
            composed = compose("train", [f"+exp={name}", f"scale={scale}"], places)
            found.setdefault(name, {})[scale] = measure_size(composed, evaluations(composed, config))
            bar.advance(f"{name} at scale {scale}")
    size_table([(name, scale, size) for name in found for scale, size in found[name].items()]).print()
    return found


def evaluations(composed: Mapping[str, Any], config: Mapping[str, Any]) -> list[int]:
    """The NFEs at which an experiment is measured."""
    return config["nfe"] or composed["evaluation"]["nfe"]


def of_measured(experiment: str, config: Mapping[str, Any], places: Places) -> dict[str, Any]:
    """The composed experiment whose speed is measured."""
    overrides = [f"+exp={experiment}", f"scale={config['at_scale']}", *config["overrides"]]
    return compose("train", overrides, places)


def measure_and_print(
    experiment: str, composed: Mapping[str, Any], config: Mapping[str, Any]
) -> dict[str, Any]:
    """All figures of an experiment except its size."""
    log.info("measuring %s at scale %s", experiment, config["at_scale"])
    with tempfile.TemporaryDirectory() as scratch:
        figures = measure(composed, config, Path(scratch))
    for table in tables_of(experiment, figures):
        table.print()
    return figures


def measure(composed: Mapping[str, Any], config: Mapping[str, Any], scratch: Path) -> dict[str, Any]:
    """The requested figures of one experiment."""
    # Imported late: it takes seconds, and mistakes in the config are reported first.
    import torch

    from imfvla.benchmarks.latency import measure_latency
    from imfvla.benchmarks.simulation import measure_demonstrations, measure_simulation
    from imfvla.benchmarks.training import measure_training
    from imfvla.command.rehearsal import build_unfitted
    from imfvla.environments import environment_of
    from imfvla.policy import build_policy
    from imfvla.rollouts.threads import threads
    from imfvla.sources.mcap import McapSource
    from imfvla.training.data import prepare_windows

    parts, figures = config["parts"], {}
    with closing(environment_of(composed)) as env:
        if "simulation" in parts:
            figures["simulation"] = measure_simulation(env)
        if "simulation" in parts or "training" in parts:
            demonstrating, demonstrations = measure_demonstrations(composed, scratch)
            figures.setdefault("simulation", {}).update(demonstrating)
        torch.manual_seed(0)
        if "training" in parts:
            source = McapSource(demonstrations)
            policy = build_policy(composed, prepare_windows(composed, source).statistics())
            with threads(torch.get_num_threads()):
                figures["training"] = measure_training(
                    composed, policy, source, scratch / "run", config["training_steps"]
                )
        else:
            policy = build_unfitted(composed)
        if "latency" in parts:
            figures["latency"] = measure_latency(
                env,
                policy.eval(),
                evaluations(composed, config),
                calls=config["latency_calls"],
                warm_up=config["latency_warm_up"],
            )
    return {"parameters": sum(parameter.numel() for parameter in policy.parameters()), **figures}


def tables_of(experiment: str, figures: Mapping[str, Any]) -> list[Table]:
    """The figures of one experiment for people."""
    speed = []
    if "simulation" in figures:
        speed += simulation_rows(figures["simulation"])
    if "training" in figures:
        speed += training_rows(figures["training"])
    title = f"{experiment}, {number(figures['parameters'] / 1e6, 2)} M parameters"
    tables = [Table(title, ("What", "Value", "Unit"), tuple(speed))] if speed else []
    if "latency" in figures:
        tables.append(latency_table(experiment, figures["latency"]))
    return tables


if __name__ == "__main__":
    main()
