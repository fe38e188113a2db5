"""Judges a policy without an environment: how far its chunks are from what was done in episodes that it never saw.

Shapes: W decisions, N decisions of training episodes, S state, Tp predicted steps, A action.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from imfvla.config.condition import UNCHANGED
from imfvla.config.protocol import EAGER, FRESH, PAUSED, EvaluationOptions
from imfvla.data import Windows
from imfvla.data.same_content import refuse_other_content
from imfvla.errors import UserError
from imfvla.options import require
from imfvla.policy import Policy
from imfvla.policy.noise import chunk_noise
from imfvla.process.progress import Progress
from imfvla.reporting.offline import FILE, HOLD, NEAREST, read_offline
from imfvla.robot import RobotSpec, bare_name
from imfvla.sources.opening import open_source
from imfvla.storage.files import write_json
from imfvla.storage.fingerprint import fingerprint
from imfvla.storage.run_directory import RunDirectory
from imfvla.storage.trained_config import refuse_changed_config, trained_data
from imfvla.training.checkpoint import load_policy
from imfvla.training.data import held_out_windows, prepare_windows

MOST_DECISIONS = 1000  # that are judged, spread evenly over the held-out episodes
MOST_COMPARED = 20_000  # of the training episodes, among which the nearest is looked for
ROWS = 32  # chunks that are computed together


def refuse_rollout_options(options: EvaluationOptions) -> None:
    """Raises UserError where an option asks for what only an environment has."""
    for key, usual in (
        ("clock", PAUSED),
        ("noise", FRESH),
        ("candidates", 1),
        ("condition", UNCHANGED),
        ("runtime", EAGER),
        ("batch", 1),
    ):
        found = getattr(options, key)
        require(found == usual, f"evaluation.{key}", "as usual where there is no environment", found)


def evaluate_offline(
    run: RunDirectory, config: Mapping[str, Any], options: EvaluationOptions
) -> dict[str, Any]:
    """The content of `offline.json` in the run directory, which is written unless it is there already.

    `config` is the run's, and says where its data lies. For chunks of each of `options.nfe`, for holding still and for
    the actions of the nearest training decision: the mean absolute error (Tp, A) in the units of the channels, over the
    held-out decisions; steps past an episode's end do not count, and are null where none counts. Raises UserError where
    there are no such weights, and where these were trained with another config or on other data.
    """
    refuse_rollout_options(options)
    step = run.weights_step(options.checkpoint)
    refuse_changed_config(run, run.config(), step)
    windows = prepare_windows(config, open_source(config))
    # Among other episodes those that are held out may be those that it was trained on.
    refuse_other_content(trained_data(run, step), windows.store, f"the weights of step {step}")
    unseen = held_out_windows(windows)
    protocol = {
        "checkpoint_step": step,
        "weights": run.weights_digest(step),
        "nfe": list(options.nfe),
        "noise_seed": options.noise_seed,
        "noise_scale": options.noise_scale,
        "device": options.device,
        "held_out": [windows.store.episodes[number].name for number in unseen.chosen],
    }
    stored = read_offline(run)
    if stored is not None and stored["protocol"] == protocol and not options.overwrite:
        return stored
    policy = load_policy(run, step).to(options.device)
    chosen = np.unique(np.linspace(0, len(unseen) - 1, min(MOST_DECISIONS, len(unseen))).astype(int))
    state, actions, valid = unseen.decided(chosen)
    trained = np.unique(np.linspace(0, len(windows) - 1, min(MOST_COMPARED, len(windows))).astype(int))
    statistics = windows.statistics()
    rows = {
        HOLD: _errors(_hold(state, policy.robot, statistics.action_mean)[:, None], actions, valid),
        NEAREST: _errors(_nearest(state, *windows.decided(trained)[:2]), actions, valid),
    }
    for nfe in options.nfe:
        policy.check_sampling(nfe, options.noise_scale)
        rows[f"infer{nfe}"] = _errors(_predicted(policy, unseen, chosen, nfe, options), actions, valid)
    found = {
        "experiment": config["name"],
        "protocol": protocol,
        "decisions": len(chosen),
        "executed": policy.horizon.exec,
        "channels": list(policy.robot.action),
        "deviation": [float(value) for value in statistics.action_std],
        "error": {name: _listed(error) for name, error in rows.items()},
        "fingerprint": fingerprint(threads=torch.get_num_threads()),
    }
    write_json(run.path / FILE, found)
    return found


def _hold(state: np.ndarray, robot: RobotSpec, mean: np.ndarray) -> np.ndarray:
    """The actions (W, A) that keep the present state (W, S).

    Of an absolute action it is the state channel of its name, and where there is none the mean action (A,).
    """
    names = [bare_name(channel) for channel in robot.state]
    kept = np.empty((len(state), len(robot.action)), np.float32)
    for number, (channel, origin) in enumerate(zip(robot.action, robot.relative_to, strict=True)):
        if origin is None and bare_name(channel) in names:
            origin = names.index(bare_name(channel))
        kept[:, number] = mean[number] if origin is None else state[:, origin]
    return kept


def _nearest(state: np.ndarray, known: np.ndarray, actions: np.ndarray) -> np.ndarray:
    """The actions (W, Tp, A), of those (N, Tp, A) decided at `known` (N, S), nearest to each state (W, S)."""
    scale = np.maximum(known.std(axis=0), np.finfo(np.float32).eps)
    known, state = known / scale, state / scale
    lengths = np.square(known).sum(axis=1)
    nearest = [int(np.argmin(lengths - 2 * known @ one)) for one in state]
    return actions[nearest]


def _predicted(
    policy: Policy, windows: Windows, chosen: np.ndarray, nfe: int, options: EvaluationOptions
) -> np.ndarray:
    """A chunk at each decision: float32 (W, Tp, A).

    The noise at decision w is drawn from SeedSequence([noise_seed, w]) alone, so that all policies see the same.
    """
    chunks = []
    with torch.inference_mode(), Progress(f"held-out decisions, nfe {nfe}", len(chosen)) as bar:
        for first in range(0, len(chosen), ROWS):
            indices = chosen[first : first + ROWS]
            observation = windows.batch(indices, np.random.default_rng(0)).obs.to(options.device)
            drawn = chunk_noise(policy.noise_shape, [(options.noise_seed, index) for index in indices])
            noise = (options.noise_scale * drawn).to(options.device)
            chunks.append(policy.predict(observation, noise, nfe).float().cpu().numpy())
            for _ in indices:
                bar.advance()
    found = np.concatenate(chunks)
    if not np.isfinite(found).all():
        raise UserError(
            f"The policy predicts numbers that are not finite at nfe {nfe}: evaluate other weights, or train again."
        )
    return found


def _errors(chunks: np.ndarray, actions: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Mean absolute error (Tp, A) of chunks that broadcast to (W, Tp, A), over what is valid; NaN where nothing is."""
    counted = valid[..., None]
    error = (np.abs(chunks - actions) * counted).sum(axis=0, dtype=np.float64)
    number = counted.sum(axis=0)
    return np.where(number > 0, error / np.maximum(number, 1), np.nan)


def _listed(error: np.ndarray) -> list[list[float | None]]:
    return [[float(value) if np.isfinite(value) else None for value in step] for step in error]
