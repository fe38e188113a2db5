"""The run directory: the contract between training, evaluation and tables. Needs neither torch nor mujoco.

config.yaml  overrides.json  status.json  train.log  metrics.jsonl  tensorboard/
checkpoints/last/state.safetensors            to resume from, bit for bit
checkpoints/step-N/policy.{safetensors,json}  averaged weights to use
rollouts/<evaluation>/
"""

import hashlib
import json
import os
import re
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from fractions import Fraction
from pathlib import Path
from typing import Any

import yaml

from imfvla.config.protocol import CHECKPOINT, LAST
from imfvla.errors import UserError, unreadable
from imfvla.options import require
from imfvla.storage.documents import read_yaml
from imfvla.storage.files import (
    clear_write_errors,
    delete_leftovers,
    make_folder,
    sync,
    take_lock,
    write_json,
    write_text,
)
from imfvla.storage.opening import WEIGHTS, open_to_append, open_to_read, refuse_strangers
from imfvla.storage.records import STATES, RunConfig, Status, as_record, read_record

OVERRIDES = "overrides.json"
REMEDY = "delete it; commands are then read from the directory's name"
RUNNING, DONE, FAILED = STATES
PARENTS = 3  # runs/<experiment>/<name>, which Hydra makes without forcing them to disk
# Keys that say how or where a run executes, not what it trains: they neither name nor distinguish runs.
EXECUTION_KEYS = (
    "evaluation",
    "demos.workers",
    "demos.directory",
    "demos.frames_directory",
    "training.threads",
    "training.compile",
    "training.sharding",
    "training.on_non_finite",
    "training.accumulate",
    "training.prefetch",
    "training.loader_threads",
    "training.log_every",
    "training.save_every_s",
)
# Keys that follow from others: the robot, and the numbers of views, states and actions, which older runs have too.
DERIVED_KEYS = (
    "robot",
    "state_dim",
    "action_dim",
    "observation.num_views",
    "encoder.views",
    "encoder.state_dim",
    "core.channels",
    "core.state_token",
)
# What a key is in a run that is older than the key.
LATER_KEYS = {
    "demos.source": "scripted",
    "horizon.prefix_max": 0,
    "task.expert.recoveries": 0,
    "task.expert.max_turn": None,
}


class RunDirectory:
    """Paths and small files of one run. Reading creates nothing."""

    def __init__(self, path: Path | str) -> None:
        self.path = Path(path)

    @property
    def checkpoints(self) -> Path:
        return self.path / "checkpoints"

    @property
    def last_state(self) -> Path:
        return self.checkpoints / "last" / "state.safetensors"

    @property
    def metrics(self) -> Path:
        return self.path / "metrics.jsonl"

    @property
    def tensorboard(self) -> Path:
        return self.path / "tensorboard"

    def rollouts(self, name: str) -> Path:
        """Where the evaluation `name` keeps its episodes."""
        return self.path / "rollouts" / name

    def weights_directory(self, step: int) -> Path:
        return self.checkpoints / f"step-{step}"

    def weight_steps(self) -> list[int]:
        """Training steps whose weights are kept, ascending."""
        found = (re.fullmatch(r"step-(\d+)", path.name) for path in self.checkpoints.glob("step-*"))
        return sorted(int(match.group(1)) for match in found if match)

    def policy_weights(self, step: int | str = LAST) -> Path:
        """`policy.safetensors` of what `weights_step` takes."""
        return self.weights_directory(self.weights_step(step)) / "policy.safetensors"

    def weights_step(self, step: int | str = LAST) -> int:
        """The training step of the kept weights that `checkpoint` names: see `EvaluationOptions.checkpoint`.

        Raises UserError where there are none.
        """
        steps = self.weight_steps()
        if not steps:
            raise UserError(f"{self.path} has no weights in checkpoints/step-*: wanted a trained run.")
        if step == LAST:
            return steps[-1]
        if "/" in str(step):
            step = step_of(self.training_steps(), step)
        if str(step) not in map(str, steps):
            kept = ", ".join(str(known) for known in steps)
            raise UserError(
                f"{self.checkpoints} has no weights of step {step}: kept are {kept}, or take last."
            )
        return int(step)

    def weights_digest(self, step: int | str = LAST) -> str:
        """16 hex digits of the file that `policy_weights` names. Raises UserError where it cannot be read."""
        path = self.policy_weights(step)
        try:
            with open_to_read(path, WEIGHTS, home=self.path) as stream:
                return hashlib.file_digest(stream, "sha256").hexdigest()[:16]
        except FileNotFoundError:
            raise UserError(f"{path} is missing: train again, or take another checkpoint=...") from None
        except PermissionError as error:
            raise unreadable(path, error) from error

    def config(self) -> dict[str, Any]:
        """The resolved config of the run. Raises UserError where there is none or the file is broken."""
        path = self.path / "config.yaml"
        try:
            config = read_yaml(path)
        except FileNotFoundError:
            raise UserError(f"{self.path} is not a run directory: it has no {path.name}.") from None
        return as_record(config, RunConfig, str(path), "restore it from a copy")

    def refuse_strangers(self) -> None:
        """Raises UserError where a link would redirect writes to somewhere else, or a pipe would block them."""
        refuse_strangers(self.path)

    def training_steps(self) -> int:
        """The number of training steps. Raises UserError where the config does not give it."""
        return training_steps(self.config(), self.path)

    def claim(self, config: Mapping[str, Any], *, ignored: tuple[str, ...] = ()) -> None:
        """Claims the directory for this config: writes config.yaml, or compares with the existing one.

        `ignored` keys may differ (they say how a run executes). Where nothing was trained yet, as after a command that
        found mistakes in its data, another config takes the place of the old one. Raises UserError naming other keys
        that differ.
        """
        path = self.path / "config.yaml"
        differing = differences(self.config(), plain(config), ignored) if path.exists() else []
        if differing and self._has_results:
            raise UserError(
                f"{self.path} holds a run with another config: {'; '.join(differing)}. Choose another "
                "name=..., or delete that directory if it is not needed."
            )
        if differing:
            (self.path / OVERRIDES).unlink(missing_ok=True)
        if differing or not path.exists():
            write_text(path, yaml.safe_dump(plain(config), sort_keys=False))

    @property
    def _has_results(self) -> bool:
        """Whether anything was trained or evaluated here."""
        return any(path.exists() for path in (self.metrics, self.checkpoints, self.path / "rollouts"))

    def keep_overrides(self, overrides: Sequence[str]) -> None:
        """Records the overrides of the command that began the run, unless there are none or some are kept already."""
        path = self.path / OVERRIDES
        if overrides and not path.exists():
            write_json(path, list(overrides))

    def overrides(self) -> list[str] | None:
        """Those of `keep_overrides`, None without any. Raises UserError where the file is broken."""
        path = self.path / OVERRIDES
        if not path.exists():
            return None
        return read_record(path, list[str], REMEDY)

    def status(self) -> dict[str, Any]:
        """The content of status.json, {} before the first one. Raises UserError where it is broken."""
        path = self.path / "status.json"
        if not path.exists():
            return {}
        return read_record(path, Status, "delete it and run again")

    def write_status(self, state: str, **details: Any) -> None:
        """state: running, done or failed; `details` (step, error, ...) replace those of before."""
        write_json(
            self.path / "status.json",
            {"state": state, "updated": time.strftime("%Y-%m-%dT%H:%M:%S%z"), **details},
        )

    @contextmanager
    def lock(self) -> Iterator[None]:
        """Held while a process trains here. Raises UserError where another one does."""
        path = self.path / ".lock"
        with clear_write_errors(path):
            make_folder(self.path)
            for parent in [*self.path.absolute().parents][:PARENTS]:
                with suppress(PermissionError):
                    sync(parent)
            file = open_to_append(path)
        with file:
            if not take_lock(file.fileno(), self.path):
                file.seek(0)
                owner = file.read().strip() or "unknown"
                raise UserError(f"{self.path} is in use by process {owner}: wait for it or stop it.")
            with clear_write_errors(path):
                file.truncate(0)
                file.write(str(os.getpid()))
                file.flush()
            for written in (
                self.path / "config.yaml",
                self.path / "status.json",
                self.metrics,
                self.last_state,
            ):
                delete_leftovers(written)
            for leftover in self.last_state.parent.glob(".tmp*"):  # of versions before
                with suppress(OSError):
                    leftover.unlink()
            yield


def training_steps(config: Mapping[str, Any], run: Path) -> int:
    """The number of training steps in a run's config. Raises UserError where it is missing or wrong."""
    training = config.get("training")
    steps = training.get("steps") if isinstance(training, Mapping) else None
    if not isinstance(steps, int) or isinstance(steps, bool) or steps < 1:
        raise UserError(f"{run}/config.yaml must have training.steps of at least 1, found {steps!r}.")
    return steps


def step_of(steps: int, checkpoint: int | str) -> int:
    """The step that a checkpoint names in a training of `steps` steps: see `EvaluationOptions.checkpoint`.

    Raises UserError where it names none.
    """
    require(CHECKPOINT.holds(checkpoint), "checkpoint", CHECKPOINT.wanted, checkpoint)
    if checkpoint == LAST:
        return steps
    return round(steps * Fraction(checkpoint)) if "/" in str(checkpoint) else int(checkpoint)


def config_digest(config: Mapping[str, Any], ignored: tuple[str, ...] = ()) -> str:
    """16 hex digits that change with any key but the ignored ones and those that follow from others."""
    return digest_of_entries(flatten(plain(config)), (*ignored, *DERIVED_KEYS))


def digest_of_entries(entries: Mapping[str, Any], ignored: tuple[str, ...]) -> str:
    """16 hex digits of dotted keys and their values, without the ignored keys and what is below these."""
    kept = {key: value for key, value in entries.items() if not _is_below(key, ignored)}
    return hashlib.sha256(json.dumps(kept, sort_keys=True).encode()).hexdigest()[:16]


def differences(old: Mapping[str, Any], new: Mapping[str, Any], ignored: tuple[str, ...] = ()) -> list[str]:
    """One "key was a, is b" per key of nested mappings whose values differ, those apart that follow from others."""
    before, after = LATER_KEYS | flatten(old), LATER_KEYS | flatten(new)
    keys = [key for key in {**before, **after} if not _is_ignored(key, ignored)]
    absent = object()
    return [
        f"{key} was {_shown(before, key)}, is {_shown(after, key)}"
        for key in keys
        if before.get(key, absent) != after.get(key, absent)
    ]


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested mappings as one mapping from dotted keys to leaves; lists are leaves."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        flat |= flatten(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def plain(value: Any) -> Any:
    """The same with dicts and lists only, as YAML gives it back."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    return [plain(item) for item in value] if isinstance(value, list | tuple) else value


def _is_ignored(key: str, ignored: tuple[str, ...]) -> bool:
    return _is_below(key, (*ignored, *DERIVED_KEYS))


def _is_below(key: str, names: tuple[str, ...]) -> bool:
    return any(key == name or key.startswith(f"{name}.") for name in names)


def _shown(flat: Mapping[str, Any], key: str) -> str:
    return repr(flat[key]) if key in flat else "absent"
