"""Reports in a loop over a run directory into which a training and evaluations write."""

import os
import random
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

from fakes import build_fakes
from synthetic_runs import make_run

from faults.killing import ended_or_late, last_words, start
from faults.outcome import Differs
from faults.work import OF_FAKES, OPTIONS_OF_FAKES, train
from imfvla.reporting.answers import Sources
from imfvla.reporting.results import Result
from imfvla.reporting.runs import evaluations
from imfvla.reporting.tables import other_table
from imfvla.rollouts.evaluation import evaluate
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import read_metrics

EPISODES, MAX_S = 3, 900.0


def reports(folder: Path, kills: int, rng: random.Random) -> str:
    """No report fails, and each has all episodes of an evaluation or none."""
    run = RunDirectory(make_run(folder / "runs" / "run", "socket_ph32_exec16", **OF_FAKES))

    def write(_: Path) -> None:
        train(run.path, steps=2 * kills)
        for _ in range(kills):
            options = replace(OPTIONS_OF_FAKES, episodes=EPISODES, overwrite=True, recordings=False)
            evaluate(run, options, build=build_fakes)

    child, deadline, found = start(write, folder / "writing"), time.monotonic() + MAX_S, Counter()
    while ended_or_late(child, deadline):
        read_metrics(run.metrics), run.config(), run.status()
        other_table([Result(source) for source in Sources([folder / "runs"]).others([])])
        found[tuple(len(evaluation.episodes) for evaluation in evaluations(run))] += 1
    if code := os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]):
        raise Differs(f"the writing process ended with {code}: {last_words(folder / 'writing')}")
    if found.keys() - {(), (EPISODES,)}:
        raise Differs(f"evaluations of {sorted(found)} episodes were reported")
    whole = found[EPISODES,]
    return f"{found.total()} reports, {whole} with an evaluation: none failed, none were mixed"
