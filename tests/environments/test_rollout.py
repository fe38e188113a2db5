"""One episode: what its row says, what its recorders see, and how it ends."""

import json
from collections.abc import Callable

import numpy as np
import pytest
from fakes import ROBOT, FakeEnvironment, known_actions

from imfvla.environments.rollout import NON_FINITE, SIMULATION_ENDED, ActionError, run_episode
from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.recording import McapSink, read_episode


class ScriptedActor:
    """Plays the known actions; `act_at` answers instead at single steps."""

    def __init__(
        self, act_at: dict[int, Callable[[], Decision]] | None = None, done_at: int | None = None
    ) -> None:
        self.style = {"speed": 1.0}
        self._act_at, self._actions, self._done_at = act_at or {}, known_actions(40), done_at

    def reset(self, env: FakeEnvironment, seed: int) -> None:
        self._seed, self._steps = seed, 0

    def act(self, env: FakeEnvironment, state: np.ndarray, step: int) -> Decision:
        self._steps += 1
        if step in self._act_at:
            return self._act_at[step]()
        inference_ms = 2.0 if step % 10 == 0 else None
        return Decision(self._actions[step], self._actions[step], inference_ms=inference_ms)

    def done(self, env: FakeEnvironment) -> bool:
        return self._steps == self._done_at


class Recorder:
    """Keeps what a sink receives; raises at a chosen step."""

    def __init__(self, fail_at: int | None = None) -> None:
        self.events: list[str] = []
        self.steps: list[Step] = []
        self.info: EpisodeInfo | None = None
        self.result: EpisodeResult | None = None
        self._fail_at = fail_at

    def begin(self, env: FakeEnvironment, info: EpisodeInfo) -> None:
        self.events.append("begin")
        self.info = info

    def step(self, env: FakeEnvironment, step: Step) -> None:
        if step.index == self._fail_at:
            raise OSError("disk full")
        self.steps.append(step)

    def end(self, result: EpisodeResult) -> None:
        self.events.append("end")
        self.result = result

    def abort(self) -> None:
        self.events.append("abort")


def play(
    actor: ScriptedActor, *, seed: int = 3, env: FakeEnvironment | None = None, sinks=(), **options
) -> EpisodeResult:
    return run_episode(env or FakeEnvironment(), actor, seed, sinks, kind="rollout", config={}, **options)


def test_the_row_of_a_whole_episode():
    result = play(ScriptedActor())
    assert (result.num_steps, result.failure, result.success) == (40, None, True)
    # The stage after the step; it is 1 once 8 steps are done.
    assert result.first_step_of_stage == (7, 15, 23)
    assert result.total_reward == 8 * (1 + 2) + 3 * 17
    assert result.max_reward == 3
    assert result.inference_ms == (2.0, 2.0, 2.0, 2.0)
    assert result.start_digest == "0000000000000003"


def test_a_stage_that_was_never_reached():
    result = play(ScriptedActor(), seed=1)
    assert (result.first_step_of_stage, result.success) == ((7, -1, -1), False)


def test_a_demonstrator_stops_when_it_is_done_and_a_limit_stops_anyone():
    assert play(ScriptedActor(done_at=12)).num_steps == 12
    assert play(ScriptedActor(), max_steps=5).num_steps == 5


def test_recorders_see_each_step_with_the_state_before_and_the_stage_after():
    recorder = Recorder()
    result = play(ScriptedActor(), sinks=[recorder], metadata={"nfe": 2})
    assert recorder.events == ["begin", "end"]
    assert recorder.result is result
    assert recorder.info.metadata == {"nfe": 2, "style": {"speed": 1.0}}
    assert [step.index for step in recorder.steps] == list(range(40))
    assert [step.state[0] for step in recorder.steps] == list(range(40))
    assert [step.stage for step in recorder.steps][7:9] == [1, 1]
    assert recorder.steps[10].time_s == pytest.approx(0.2)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_non_finite_action_ends_the_episode_with_a_label(bad):
    env, recorder = FakeEnvironment(), Recorder()
    action = np.full(len(ROBOT.action), bad, np.float32)
    result = play(ScriptedActor({30: lambda: Decision(action, action)}), env=env, sinks=[recorder])
    assert (result.failure, result.num_steps, result.success) == (NON_FINITE, 30, False)
    assert result.max_reward == 3
    assert len(env.executed) == 30
    assert recorder.events == ["begin", "end"]


def test_an_actor_may_label_the_end_itself():
    def refuse() -> Decision:
        raise ActionError("no plan")

    result = play(ScriptedActor({0: refuse}))
    assert (result.failure, result.num_steps, result.total_reward, result.max_reward) == (
        "no plan",
        0,
        0.0,
        0.0,
    )


def test_a_simulation_that_ends_before_its_time_is_a_failure():
    assert play(ScriptedActor(), env=FakeEnvironment(ends_at=9)).failure == SIMULATION_ENDED


def test_any_other_exception_aborts_all_recorders_and_is_raised_again():
    first, second = Recorder(), Recorder(fail_at=3)
    with pytest.raises(OSError, match="disk full"):
        play(ScriptedActor(), sinks=[first, second])
    assert first.events == second.events == ["begin", "abort"]


def test_an_episode_with_a_label_is_recorded_whole(tmp_path):
    action = np.full(len(ROBOT.action), np.nan, np.float32)
    actor = ScriptedActor({6: lambda: Decision(action, action)})
    play(actor, sinks=[McapSink(tmp_path / "failed.mcap", render_every=2)])
    episode = read_episode(tmp_path / "failed.mcap")
    assert episode.result.failure == NON_FINITE
    np.testing.assert_array_equal(episode.executed, known_actions(40)[:6])


def test_equal_seeds_give_equal_rows():
    from imfvla.reporting.rows import row_of, untimed

    rows = [json.dumps(untimed(row_of(play(ScriptedActor(), seed=2)))) for _ in range(2)]
    assert rows[0] == rows[1]
