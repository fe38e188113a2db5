"""An experiment from nothing to its row of the table: collect or open data, train, evaluate. A rerun resumes it."""

import logging
import os
import traceback
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from typing import Any

import numpy as np
import torch

from imfvla.command.rehearsal import checked_options, rehearse
from imfvla.config.views import view_options
from imfvla.data.held_out import held_out
from imfvla.deployment.ready import check_runtime, export_missing
from imfvla.environments import BIMANUAL, environment_of, kind_of
from imfvla.errors import UserError
from imfvla.nn.pretrained import initialise_from_pretrained
from imfvla.options import require
from imfvla.policy import build_policy
from imfvla.process.gl import select_gl_backend
from imfvla.reporting.offline_tables import print_offline
from imfvla.reporting.table_row import print_row
from imfvla.robot_of import has_environment, robot_of, with_robot
from imfvla.rollouts.evaluation import evaluate, refuse_long_delay
from imfvla.rollouts.offline import evaluate_offline
from imfvla.sources.base import EpisodeSource
from imfvla.sources.collection import check_demonstrations
from imfvla.sources.opening import SCRIPTED, open_source, source_kind
from imfvla.sources.same_robot import refuse_other_robot
from imfvla.storage.run_directory import DONE, EXECUTION_KEYS, FAILED, RUNNING, RunDirectory, plain
from imfvla.training.checkpoint import check_weights
from imfvla.training.data import check_episodes, make_loader, prepare_windows, refuse_other_source
from imfvla.training.experiment import ExperimentOptions
from imfvla.training.far_targets import far_targets
from imfvla.training.loop import Trainer
from imfvla.training.parallel import Alone, joined_processes

STAGES = TRAIN, EVALUATE = "train", "evaluate"
INITIALISATION_STREAM = 2  # of the random numbers that initialise a policy
log = logging.getLogger(__name__)


def run_experiment(config: Mapping[str, Any], run: RunDirectory, overrides: Sequence[str] = ()) -> None:
    """Does the remaining work of the experiment in `run` and prints its row, or how it does offline.

    `config` is train.yaml composed under `overrides`, as plain dicts. status.json says running, then done, or failed
    with the traceback. Raises UserError on a bad config, a directory that holds another run, data that cannot be
    collected.
    """
    options = checked_options(config)
    is_trained = options.training.steps in run.weight_steps()
    config = with_robot(config)
    refuse_long_delay(config, options.evaluation)
    check_runtime(config, options.evaluation)
    policy = rehearse(config, options.evaluation)
    source = None
    if not is_trained:
        source = _check_source(config)
        if not run.last_state.exists():
            initialise_from_pretrained(policy)
    run.refuse_strangers()
    if has_environment(config) and run.status().get("state") != DONE:
        _check_environment(config)  # else training would end before an evaluation that fails
    with joined_processes(options.training.device) as processes:
        if not is_trained:
            processes.check(options.training)
        if processes.is_first:
            _run_stages(config, options, run, overrides, processes, source)
        elif processes.first_of(STAGES, TRAIN) == TRAIN:
            _train(config, options, run, processes)


def _refuse_other_robot(config: Mapping[str, Any], run: RunDirectory) -> None:
    """Raises UserError where the run in this directory is of another robot, which its data may have brought."""
    refuse_other_robot(
        robot_of(run.config()),
        robot_of(config),
        view_options(config).views,
        of=f"the run in {run.path}",
        where="The task or its data",
        remedy="Choose another name=... for it.",
    )


def _check_environment(config: Mapping[str, Any]) -> None:
    """Raises UserError where nothing can be drawn, or where the environment has another robot than it states."""
    if kind_of(config["task"]) == BIMANUAL:
        select_gl_backend()
        return
    with closing(environment_of(config)) as env:
        refuse_other_robot(
            robot_of(config),
            env.robot,
            view_options(config).views,
            of="task.robot",
            where=f"The environment {env.name}",
            remedy="Correct task.robot.",
        )


def _check_source(config: Mapping[str, Any]) -> EpisodeSource | None:
    """The data to learn from, None where an expert will record it.

    Raises UserError where there is none, or of another robot; records nothing.
    """
    if source_kind(config) == SCRIPTED:
        require(
            has_environment(config), "demos", "a source of data where task=none, such as demos=mcap", SCRIPTED
        )
        check_demonstrations(config)
        return None
    source = open_source(config)
    refuse_other_source(config, source)
    held_out(config["task"], len(source))
    return source


def _run_stages(
    config: Mapping[str, Any],
    options: ExperimentOptions,
    run: RunDirectory,
    overrides: Sequence[str],
    processes: Alone,
    source: EpisodeSource | None,
) -> None:
    """All stages, except the other processes' shares of training. source: data whose numbers are to be checked."""
    if source is not None:
        check_episodes(config, source)  # before the directory is claimed
    with run.lock():
        run.claim(config, ignored=EXECUTION_KEYS)
        _refuse_other_robot(config, run)
        run.keep_overrides(overrides)
        try:
            is_trained = options.training.steps in run.weight_steps()
            processes.first_of(STAGES, EVALUATE if is_trained else TRAIN)
            if is_trained:
                log.info(f"{run.path} is trained already: all {options.training.steps} steps are done.")
                check_weights(run, options.evaluation.checkpoint)
            else:
                _train(config, options, run, processes)
                run.write_status(RUNNING, phase="evaluation", pid=os.getpid())
            if has_environment(config):
                export_missing(run, options.evaluation)
                evaluate(run, options.evaluation)  # of a finished evaluation it only reads the summary
            else:
                evaluate_offline(run, config, options.evaluation)
            if run.status().get("state") != DONE:
                run.write_status(DONE)
        except KeyboardInterrupt:
            run.write_status(FAILED, error="interrupted; rerun the same command to resume")
            raise
        except Exception as error:
            with suppress(UserError):  # a full disk must not hide the error
                run.write_status(FAILED, error=str(error), traceback=traceback.format_exc())
            raise
    if has_environment(config):
        print_row(run)
    else:
        print_offline(run)


def _train(
    config: Mapping[str, Any], options: ExperimentOptions, run: RunDirectory, processes: Alone
) -> None:
    if processes.is_first:
        run.write_status(RUNNING, phase="demonstrations", pid=os.getpid())
        windows = prepare_windows(config, open_source(config))
        run.write_status(RUNNING, phase="training", pid=os.getpid())
        processes.wait()
    else:
        processes.wait()  # for demonstrations and frame store, which exist by then
        windows = prepare_windows(config, open_source(config))
    initial = np.random.SeedSequence([options.seed, INITIALISATION_STREAM]).generate_state(1, np.uint64)
    torch.manual_seed(int(initial[0]))
    policy = build_policy(config, windows.statistics())
    if processes.is_first and (far := far_targets(windows, policy.chunks)):
        log.warning(far)
    if not run.last_state.exists():  # a state has the weights, and their file may be gone
        initialise_from_pretrained(policy)
    num_parameters = sum(parameter.numel() for parameter in policy.parameters())
    log.info(f"{len(windows)} training items, {num_parameters / 1e6:.2f} M parameters")
    trainer = Trainer(
        policy,
        make_loader(options, windows),
        run,
        options.training,
        options.optim,
        seed=options.seed,
        description={
            "name": options.name,
            "seed": options.seed,
            "num_parameters": num_parameters,
            "robot": robot_of(config).to_json(),
            "config": plain(config),
            "data": dict(windows.store.content),
        },
        processes=processes,
    )
    trainer.train()
