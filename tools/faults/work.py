"""What is disturbed: trainings, collections and evaluations of the tests' tiny policy and stand-in for a simulator."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from fakes import FakeEnvironment, build_fakes, known_actions
from tiny_policy import OPTIM, OPTIONS, CountedBatches, TinyPolicy

from imfvla.config.protocol import EvaluationOptions
from imfvla.environment import Environment
from imfvla.episode import Decision
from imfvla.rollouts import workbench
from imfvla.rollouts.evaluation import evaluate
from imfvla.sources import collection
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.loop import Trainer

OF_FAKES = {  # of the config of a run that is evaluated
    "task": {"name": "fake", "variant": "default"},
    "observation": {"views": ["front"], "image_size": [16, 16]},
}
OPTIONS_OF_FAKES = EvaluationOptions(episodes=1, first_seed=100_000, nfe=(1,), workers=0)


def train(folder: Path, steps: int, save_every_s: float = 0.0) -> None:
    """A whole training, by default with a state after every step."""
    options = replace(OPTIONS, steps=steps, log_every=1, checkpoints=4, save_every_s=save_every_s)
    Trainer(
        TinyPolicy(), CountedBatches(), RunDirectory(folder), options, OPTIM, seed=7, description={}
    ).train()


def roll_out(folder: Path, episodes: int) -> None:
    """An evaluation with its three recordings."""
    run = RunDirectory(folder)
    run.weights_directory(1).mkdir(parents=True, exist_ok=True)
    (run.weights_directory(1) / "policy.safetensors").write_bytes(b"read by nobody")
    (folder / "config.yaml").write_text(yaml.safe_dump({"name": "chaos", **OF_FAKES}), encoding="utf-8")
    play(folder, episodes)


def play(folder: Path, episodes: int) -> None:
    """An evaluation of a run whose config has what OF_FAKES says."""
    workbench._bench.cache_clear()
    evaluate(RunDirectory(folder), replace(OPTIONS_OF_FAKES, episodes=episodes), build=build_fakes)


class Demonstrator:
    """Does what is known; its environment counts every fourth seed as a success."""

    def reset(self, env: Environment, seed: int) -> None:
        self.actions = known_actions(40)

    def act(self, env: Environment, state: np.ndarray, step: int) -> Decision:
        return Decision(self.actions[step], self.actions[step])


def collect(folder: Path, episodes: int) -> None:
    """Demonstrations, three of four of which fail."""
    env = FakeEnvironment()
    env.model_digest = lambda: "0" * 16
    collection._stage_for = lambda settings: (env, Demonstrator())
    task = {
        "name": "fake",
        "variant": "default",
        "expert": {"modes": 1, "noise": 0.0, "hold": 18, "dwell": 0},
    }
    demos = {"episodes": episodes, "first_seed": 0, "directory": str(folder), "camera_every": 2, "workers": 0}
    demos["frames_directory"] = None
    collection.collect(task, {"views": ["front", "top"], "image_size": [16, 16]}, demos)
