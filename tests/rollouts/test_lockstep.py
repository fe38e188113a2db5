"""Episodes side by side: what each does is what it does alone, and depends on its place and the batch's size alone."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from fakes import LIMIT, FakeEnvironment, KnownPolicy, known_actions
from small_policy import batch as batch_of
from small_policy import policy as small_policy
from torch import Tensor

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import CONTINUE, HOLD, USUAL, EvaluationOptions, Protocol, unusual
from imfvla.environments.rollout import FAR_OUT_OF_RANGE, SIMULATION_ENDED, episode, run_episode
from imfvla.errors import UserError
from imfvla.options import build
from imfvla.process.workers import worker_pool
from imfvla.reporting.rows import row_of, untimed
from imfvla.rollouts import workbench
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.clock import Clock
from imfvla.rollouts.evaluation import evaluate
from imfvla.rollouts.lockstep import Player, play_in_lockstep
from imfvla.storage.run_directory import RunDirectory
from imfvla.types import Observation

STEPS = 40
SAID = {"kind": "rollout", "config": {}}


class NoisyPolicy(KnownPolicy):
    """The noise beside known actions, for any number of observations; rounds as `rounds` says of sizes and places."""

    rounds = 0.0

    def predict(self, obs: Observation, noise: Tensor, nfe: int) -> Tensor:
        size = len(obs.state)
        self.seen.append(obs.state[:, -1, 0].int().numpy())
        rows = [self.horizon.action_steps(int(step), len(self.actions))[0] for step in self.seen[-1]]
        known = torch.from_numpy(np.stack([self.actions[own] for own in rows]))
        places = torch.arange(size).view(-1, 1, 1) + 10 * size
        repeats = len(noise) // size
        return (known + self.rounds * places).repeat_interleave(repeats, 0) + self.noise_scale * noise


def noisy(horizon: Horizon, scale: float = 0.3) -> NoisyPolicy:
    return NoisyPolicy(horizon, known_actions(STEPS), noise_scale=scale)


def player(policy, place: int, seed: int, env: FakeEnvironment | None = None, **options) -> Player:
    env = env or FakeEnvironment(STEPS)
    actor = ChunkActor(policy, policy.horizon, 1, noise_seed=0, **options)
    return Player(place, env, actor, episode(env, actor, seed, [], **SAID))


@pytest.mark.parametrize(
    ("horizon", "options"),
    [
        (Horizon(1, 8, 4), {}),
        (Horizon(3, 8, 3), {}),
        (Horizon(1, 8, 1, ensemble=0.1), {}),
        (Horizon(1, 8, 3), {"noise": "rolled"}),
        (Horizon(1, 8, 3), {"candidates": 3, "tells_jumps": True}),
        (Horizon(2, 12, 4), {"clock": Clock(Horizon(2, 12, 4), 3, HOLD)}),
        (Horizon(2, 12, 4), {"clock": Clock(Horizon(2, 12, 4), 5, CONTINUE)}),
    ],
)
def test_an_episode_does_what_it_does_alone(horizon, options):
    seeds = (7, 3, 12)
    alone = []
    for seed in seeds:
        env, policy = FakeEnvironment(STEPS), noisy(horizon)
        actor = ChunkActor(policy, horizon, 1, noise_seed=0, **options)
        result = run_episode(env, actor, seed, [], **SAID)
        alone.append((env.executed, env.looked, untimed(row_of(result))))
    policy = noisy(horizon)
    players = [player(policy, place, seed, **options) for place, seed in enumerate(seeds)]
    rows = [untimed(row_of(result)) for result in play_in_lockstep(players, size=4)]
    assert {len(steps) for steps in policy.seen} == {4}
    for one, row, (executed, looked, expected) in zip(players, rows, alone, strict=True):
        np.testing.assert_array_equal(one.env.executed, executed)
        assert one.env.looked == looked
        assert row == expected


def test_an_episode_that_ends_leaves_the_others_alone():
    class Diverging(NoisyPolicy):
        def predict(self, obs: Observation, noise: Tensor, nfe: int) -> Tensor:
            chunks = super().predict(obs, noise, nfe)
            if self.seen[-1].max() >= 20:
                chunks[1] = 1e3 * LIMIT
            return chunks

    policy = Diverging(Horizon(1, 8, 4), known_actions(STEPS), noise_scale=0.3)
    early = FakeEnvironment(STEPS, ends_at=10)
    envs = [early, FakeEnvironment(STEPS), FakeEnvironment(STEPS)]
    players = [player(policy, place, place, env) for place, env in enumerate(envs)]
    results = play_in_lockstep(players, size=3)
    assert [result.num_steps for result in results] == [10, 20, STEPS]
    assert [result.failure for result in results] == [SIMULATION_ENDED, FAR_OUT_OF_RANGE, None]
    assert [len(result.inference_ms) for result in results] == [3, 5, 10]
    assert [len(steps) for steps in policy.seen] == [3] * 10  # an empty place is filled up


def test_every_chunk_of_a_batch_takes_the_time_of_the_batch():
    policy = noisy(Horizon(1, 8, 4))
    first, second = play_in_lockstep([player(policy, place, place) for place in range(2)], size=2)
    assert first.inference_ms == second.inference_ms
    assert min(first.inference_ms) > 0


def test_other_episodes_are_closed_where_one_breaks():
    class Breaking(FakeEnvironment):
        def look(self):
            if self._step == 8:
                raise OSError("no picture")
            return super().look()

    policy, seen = noisy(Horizon(1, 8, 4)), []

    class Watching:
        def begin(self, env, info):
            seen.append("begin")

        def step(self, env, step):
            pass

        def abort(self):
            seen.append("abort")

    env = FakeEnvironment(STEPS)
    actor = ChunkActor(policy, policy.horizon, 1, noise_seed=0)
    whole = Player(0, env, actor, episode(env, actor, 1, [Watching()], **SAID))
    with pytest.raises(OSError, match="no picture"):
        play_in_lockstep([whole, player(policy, 1, 2, Breaking(STEPS))], size=2)
    assert seen == ["begin", "abort"]


def test_a_network_says_in_a_batch_what_it_says_alone():
    policy, seen = small_policy().eval(), batch_of(4).obs
    noise = torch.randn(4, *policy.noise_shape, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        chunks = policy.predict(seen, noise, 2)
        for row in range(4):
            own = slice(row, row + 1)
            alone = Observation(seen.images[own], seen.state[own], seen.instruction[own])
            torch.testing.assert_close(policy.predict(alone, noise[own], 2), chunks[own], rtol=0, atol=1e-5)


def build_rounding(run: Path, step: int):
    """A `workbench.Build` whose policy's rounding depends on size and place of a batch."""
    policy = noisy(Horizon(1, 8, 4), 0.1)
    policy.rounds = 1e-3
    return FakeEnvironment(STEPS), policy


@pytest.fixture
def run(tmp_path: Path) -> RunDirectory:
    run = RunDirectory(tmp_path / "runs" / "fake" / "default")
    run.weights_directory(20).mkdir(parents=True)
    (run.weights_directory(20) / "policy.safetensors").write_bytes(b"weights")
    config = {
        "name": "fake",
        "task": {"name": "fake"},
        "observation": {"views": ["front"], "image_size": [16, 16]},
        "horizon": {"obs": 1, "pred": 8, "exec": 4},
    }
    (run.path / "config.yaml").write_text(json.dumps(config))
    workbench._bench.cache_clear()
    return run


def roll(run: RunDirectory, **options) -> tuple[dict, list]:
    defaults = {"episodes": 6, "first_seed": 100_000, "nfe": (1,), "workers": 0, "recordings": False}
    (summary,) = evaluate(run, EvaluationOptions(**defaults | options), build=build_rounding)
    lines = (run.rollouts(summary["name"]) / "episodes.jsonl").read_text().splitlines()
    return summary, [untimed(json.loads(line)) for line in lines]


def test_an_evaluation_in_batches_is_repeated_resumed_and_recorded(run, monkeypatch):
    summary, rows = roll(
        run, batch=4, recordings=True
    )  # played twice, the recorded ones alone in their batch
    assert summary["name"] == "seeds100000-100005_nfe1_batch4"
    assert summary["protocol"]["batch"] == 4
    assert [row["seed"] for row in rows] == list(range(100_000, 100_006))
    roll_out, played = workbench.roll_out, []

    def killed(job, seeds):
        played.append(list(seeds))
        if len(played) == 2:
            raise KeyboardInterrupt
        return roll_out(job, seeds)

    with monkeypatch.context() as patched:
        patched.setattr("imfvla.rollouts.evaluation.roll_out", killed)
        with pytest.raises(KeyboardInterrupt):
            roll(run, batch=4, overwrite=True)
    partial = run.rollouts(summary["name"]) / "episodes.partial.jsonl"
    lines = partial.read_text().splitlines(keepends=True)
    assert len(lines) == 1 + 4
    partial.write_text("".join(lines[:3]))  # as if killed after two rows of the first batch
    assert roll(run, batch=4, workers=1)[1] == rows
    assert played == [list(range(100_000, 100_004)), [100_004, 100_005]]


def test_a_batch_of_one_is_the_usual_evaluation(run):
    summary, rows = roll(run)
    assert summary["name"] == "seeds100000-100005_nfe1"
    env, policy = build_rounding(run.path, 20)
    actor = ChunkActor(policy, policy.horizon, 1, noise_seed=0)
    result = run_episode(env, actor, 100_003, [], kind="rollout", config={})
    assert json.loads(json.dumps(untimed(row_of(result)))) == rows[3]


def test_a_batch_waits_for_all_its_episodes(run, monkeypatch):
    waits = []

    def watched(count, timeout_s=None):
        waits.append((count, timeout_s))
        return worker_pool(0)

    monkeypatch.setattr("imfvla.rollouts.evaluation.worker_pool", watched)
    roll(run, batch=4, workers=8, episode_timeout_s=10)
    assert waits == [(2, 40)]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"runtime": "onnx"}, "runtime must be eager with batch=4"),
        (
            {"clock": "running", "meanwhile": "continue", "prefix": "trained"},
            "prefix must be none with batch=4",
        ),
        ({"batch": 0}, "batch must be between 1 and"),
    ],
)
def test_what_a_batch_cannot_do_is_refused(options, said):
    few = {"episodes": 6, "first_seed": 0, "nfe": [1], "batch": 4}
    with pytest.raises(UserError, match=said):
        build(EvaluationOptions, few | options, "")


def test_a_batch_is_named_in_a_row():
    usual = Protocol("fake", "default", 20, "0", 1, 0, 1.0, 5, 6, None, "cpu", batch=4)
    assert unusual({**USUAL, "batch": 4}) == ("batch 4",)
    assert [usual.place(seed) for seed in (5, 8, 9)] == [0, 3, 0]
