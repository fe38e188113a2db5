"""The world side with robots of other sizes: rollout, recording, video, rows, summary and a row of a table."""

import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
import yaml
from fakes import KnownPolicy, PlainEnvironment, fake_robot, known_actions
from mcap.reader import make_reader

from imfvla.config.horizon import Horizon
from imfvla.config.protocol import EvaluationOptions
from imfvla.environments.rollout import SIMULATION_ENDED, run_episode
from imfvla.episode import Decision, EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.figures.panels import panels_of, stages_of
from imfvla.recording import McapSink, VideoSink, read_episode, read_index
from imfvla.reporting.answers import Sources, check_equal_protocols
from imfvla.reporting.mapping import PATH, read_mapping
from imfvla.reporting.results import Result
from imfvla.reporting.runs import rows
from imfvla.reporting.table_row import table_of
from imfvla.reporting.tables import other_table, row_table
from imfvla.robot import Camera, RobotSpec
from imfvla.rollouts import workbench
from imfvla.rollouts.evaluation import evaluate
from imfvla.storage.run_directory import RunDirectory

ONE = (Camera("wrist", 12, 20),)
FOUR = (Camera("high", 16, 24), Camera("low", 12, 12), Camera("left_eye", 8, 30), Camera("right_eye", 20, 10))
STAGES = ("reach", "hold", "place")
WORLDS = {
    "arm": (fake_robot(7, 7, ONE, 10.0), ()),
    "arm_on_rail": (fake_robot(8, 9, FOUR, 50.0), STAGES),
    "two_arms": (fake_robot(14, 14, ONE, 50.0), STAGES),
    "hand": (fake_robot(20, 23, FOUR, 10.0), ()),
}


@pytest.fixture(params=WORLDS)
def world(request: pytest.FixtureRequest) -> PlainEnvironment:
    robot, stages = WORLDS[request.param]
    return PlainEnvironment(name=request.param, robot=robot, stages=stages)


class Scripted:
    """Does what is known; looks and shows a chunk at every eighth step."""

    def __init__(self, robot: RobotSpec) -> None:
        self.actions = known_actions(40, robot)

    def reset(self, env: PlainEnvironment, seed: int) -> None: ...

    def act(self, env: PlainEnvironment, state: np.ndarray, step: int) -> Decision:
        action = self.actions[step]
        if step % 8:
            return Decision(action, action)
        return Decision(
            action, action, images=env.look(), chunk=self.actions[step : step + 8], inference_ms=2.0
        )


class Watcher:
    """A sink that keeps all that it is told."""

    def begin(self, env: PlainEnvironment, info: EpisodeInfo) -> None:
        self.info, self.steps = info, []

    def step(self, env: PlainEnvironment, step: Step) -> None:
        self.steps.append(step)

    def end(self, result: EpisodeResult) -> None:
        self.result = result

    def abort(self) -> None: ...


def play(env: PlainEnvironment, *sinks, seed: int = 3, actor: Scripted | None = None) -> EpisodeResult:
    return run_episode(env, actor or Scripted(env.robot), seed, sinks, kind="rollout", config={"name": "x"})


def test_an_episode_of_any_robot_comes_back_from_its_recording(world, tmp_path):
    path, seen = tmp_path / "a.mcap", Watcher()
    result = play(world, McapSink(path), seen)
    episode = read_episode(path)
    assert (episode.info, episode.result) == (seen.info, result)
    assert episode.info.robot == read_index(path).info.robot == world.robot
    np.testing.assert_array_equal(episode.state, [step.state for step in seen.steps])
    np.testing.assert_array_equal(episode.action, [step.decision.action for step in seen.steps])
    np.testing.assert_array_equal(episode.executed, world.executed)
    np.testing.assert_allclose(episode.time_s, np.arange(40) / world.robot.control_hz, atol=1e-9)
    np.testing.assert_array_equal(episode.chunks[8], known_actions(40, world.robot)[8:16])
    assert episode.image_steps.tolist() == [0, 8, 16, 24, 32]
    for camera in world.robot.cameras:
        assert episode.images[camera.name].shape == (5, camera.height, camera.width, 3)
        np.testing.assert_array_equal(
            episode.images[camera.name][2], seen.steps[16].decision.images[camera.name]
        )
    assert result.success
    assert len(result.first_step_of_stage) == len(world.stages)


def test_messages_nest_by_slashes_and_only_bodies_make_a_scene(world, tmp_path):
    play(world, McapSink(tmp_path / "a.mcap"))
    with (tmp_path / "a.mcap").open("rb") as stream:
        first = {
            channel.topic: json.loads(message.data)
            for _, channel, message in make_reader(stream).iter_messages(reverse=True)
        }
    joints = {f"joint_{number}": 0.0 for number in range(1, len(world.robot.state))}
    assert first["/robot/state"] == {"arm": joints, "gripper": 0.0}
    assert not {"/tf", "/scene"} & first.keys()


def test_a_film_has_the_robots_rate_and_all_cameras_in_proportion(world, tmp_path):
    play(world, VideoSink(tmp_path / "a.mp4", views=world.views, height=40))
    with av.open(str(tmp_path / "a.mp4")) as film:
        (stream,) = film.streams.video
        frames = sum(1 for _ in film.decode(stream))
        assert stream.average_rate == {10: 10, 50: 12.5}[world.robot.control_hz]
        assert frames / stream.average_rate == pytest.approx(40 / world.robot.control_hz)


def build(run: Path, step: int) -> tuple[PlainEnvironment, KnownPolicy]:
    """A `workbench.Build` of the world that the run is named after."""
    robot, stages = WORLDS[run.parent.name]
    policy = KnownPolicy(Horizon(1, 8, 4), known_actions(40, robot), noise_scale=0.1, robot=robot)
    return PlainEnvironment(name=run.parent.name, robot=robot, stages=stages), policy


def evaluated(world: PlainEnvironment, root: Path) -> RunDirectory:
    """A run of the world's name below `root`, with weights that nobody reads, and its evaluation."""
    run = RunDirectory(root / world.name / "default")
    run.weights_directory(10).mkdir(parents=True)
    (run.weights_directory(10) / "policy.safetensors").write_bytes(b"weights")
    config = {
        "name": world.name,
        "seed": 0,
        "training": {"steps": 10},
        "task": {"name": world.name},
        "observation": {"views": list(world.views), "image_size": [12, 20]},
    }
    (run.path / "config.yaml").write_text(yaml.safe_dump(config))
    workbench._bench.cache_clear()
    evaluate(run, EvaluationOptions(episodes=4, first_seed=100_000, nfe=(1,), workers=0), build=build)
    return run


def test_an_evaluation_has_rows_a_summary_recordings_and_its_row_of_a_table(world, tmp_path):
    run = evaluated(world, tmp_path)
    (found,) = rows(run)
    folder, summary = found.folder, found.summary
    lines = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    assert [len(line["first_step_of_stage"]) for line in lines] == [len(world.stages)] * 4
    assert summary["success_episodes"] == (1 if world.stages else 2)
    assert (summary["stages"], summary["protocol"]["variant"]) == (list(world.stages), "default")
    recorded = read_episode(folder / summary["recordings"]["best"]["file"], images=False)
    assert recorded.info.robot == world.robot
    shown = table_of(rows(run)).rows
    assert shown[0][6] == f"{summary['success_episodes']}/4"
    (result,) = (Result(found) for found in Sources([tmp_path]).others([]))
    (row,) = other_table([result]).shown.rows
    assert row[0] == world.name
    assert row[7].startswith(f"{summary['success_episodes']}/4 [")


def test_a_new_task_has_its_table_and_panels_from_the_mapping_alone(world, tmp_path):
    evaluated(world, tmp_path / "runs")
    path = tmp_path / "tables.yaml"
    row = (
        "{ name: known, method: Known, setting: infer1, experiment: %s, nfe: 1, evaluation: { episodes: 4 } }"
    )
    text = PATH.read_text().replace("\ntasks:\n", f"\ntasks:\n  {world.name}: {{ title: a new task }}\n")
    table = f"  of_known: {{ title: Known policies, task: {world.name} }}"
    path.write_text(
        text.replace("\ntables:\n", f"\ntables:\n{table}\n") + f"of_known:\n  - {row % world.name}\n"
    )
    mapping = read_mapping(path)
    sources = Sources([tmp_path / "runs"])
    (answer,) = (sources.answer(of_table, mapping) for of_table in mapping.of_table("of_known"))
    check_equal_protocols([answer], mapping.table("of_known").task)
    result = Result.of(answer)
    shown = row_table(mapping.table("of_known").title, [result]).shown
    assert shown.title == "Known policies"
    assert shown.rows[0][:3] == ("Known (infer1)", "1", "ours")
    assert shown.rows[0][7].startswith("1/4" if world.stages else "2/4")
    assert list(panels_of([result])) == ["socket peg insertion", "object transfer", world.name]
    assert stages_of([result]) == world.stages
    with pytest.raises(UserError, match=f"of_known is of the task socket, but .* played {world.name}"):
        check_equal_protocols([answer], "socket")


def test_a_world_that_ends_early_has_failed_unless_it_has_succeeded():
    robot, _ = WORLDS["arm"]
    done, failed = (play(PlainEnvironment(ends_at=12, robot=robot, stages=()), seed=seed) for seed in (1, 2))
    assert (done.success, done.failure, done.num_steps) == (True, None, 12)
    assert (failed.success, failed.failure, failed.first_step_of_stage) == (False, SIMULATION_ENDED, ())


def test_what_is_said_of_an_episode_is_read_after_its_reset():
    """In a scene that serves several tasks, the sentences of the episode before are those of another task."""
    env, seen = PlainEnvironment(), Watcher()

    def reset(seed: int) -> None:
        PlainEnvironment.reset(env, seed)
        env.instruction, env.paraphrases, env.goal = f"do {seed}", (f"please do {seed}",), f"task {seed}"

    env.reset = reset
    for seed in (1, 2):
        assert play(env, seen, seed=seed).goal == f"task {seed}"
        assert seen.info.instruction == f"do {seed}"
        assert seen.info.metadata["paraphrases"] == (f"please do {seed}",)


ROBOT = WORLDS["arm"][0]


@pytest.mark.parametrize(
    ("stated", "named"),
    [
        (
            fake_robot(6, 7, ONE, 10.0),
            r"/robot/state of step 0: arm/joint_6 must be absent from the 6 channels",
        ),
        (
            fake_robot(8, 7, ONE, 10.0),
            r"/robot/state of step 0: arm/joint_7 must be there, found only arm/joint_1",
        ),
        (fake_robot(7, 9, ONE, 10.0), r"/robot/action clean of step 0: arm/joint_7 must be there"),
        (
            replace(ROBOT, cameras=(Camera("wrist", 12, 16),)),
            r"/camera/wrist: each picture must be 12 x 16 .* 12 x 20",
        ),
    ],
)
def test_a_recording_that_is_not_of_its_robot_is_refused(tmp_path, monkeypatch, stated, named):
    path = tmp_path / "a.mcap"
    play(PlainEnvironment(robot=ROBOT, stages=()), McapSink(path))
    monkeypatch.setattr("imfvla.recording.messages._robot", lambda values, path: stated)
    with pytest.raises(UserError, match=rf"a\.mcap does not fit .*{named}.* or move it away"):
        read_episode(path)


def test_a_world_that_is_not_of_its_robot_is_refused_before_anything_is_recorded(tmp_path):
    env = PlainEnvironment(robot=ROBOT)
    env.state = lambda: np.zeros(3, np.float32)
    with pytest.raises(
        UserError, match=r"environment fake does not fit .* state\(\) must be 7 numbers.* found .*\(3,\)"
    ):
        play(env, McapSink(tmp_path / "a.mcap"))
    env = PlainEnvironment(robot=ROBOT)
    env.views = ("wrist", "side")
    with pytest.raises(UserError, match="no view 'side'"):
        play(env, McapSink(tmp_path / "a.mcap"))
    env = PlainEnvironment(robot=ROBOT)
    env.look = lambda: {"wrist": np.zeros((4, 4, 3), np.uint8)}
    with pytest.raises(
        UserError, match="Camera wrist must show 12 x 20 pixels, as the robot says, found 4 x 4"
    ):
        play(env, McapSink(tmp_path / "a.mcap"))
    assert not list(tmp_path.iterdir())
