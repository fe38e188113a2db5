"""The stages of `imfvla.train` on recorded synthetic episodes; the simulator's part is in test_train.py."""

import json

import pytest
import torch
import yaml
from fakes import FakeEnvironment

from imfvla.command import experiment
from imfvla.command.composition import compose
from imfvla.command.experiment import run_experiment
from imfvla.errors import UserError
from imfvla.robot_of import with_robot
from imfvla.sources.mcap import McapSource
from imfvla.storage.run_directory import DONE, FAILED, RunDirectory
from imfvla.training.checkpoint import load_policy
from imfvla.training.logger import read_metrics

TINY = [
    "observation.image_size=[32,32]",
    "training.batch_size=2",
    "training.steps=4",
    "training.checkpoints=2",
    "training.log_every=1",
    "training.save_every_s=0",
    "training.threads=1",
]


@pytest.fixture
def calls(synthetic_demonstrations, monkeypatch):
    """What was asked of collection, evaluation and report, which are not run."""
    seen: list[tuple] = []

    def collect(config):
        seen.append(("collect",))
        return McapSource.of(synthetic_demonstrations)

    def evaluate(run, options):
        seen.append(("evaluate", options))

    monkeypatch.setattr(experiment, "open_source", collect)
    monkeypatch.setattr(experiment, "evaluate", evaluate)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(experiment, "print_row", lambda run: seen.append(("print",)))
    return seen


def test_does_all_stages_once(calls, tmp_path):
    config, run = compose("train", TINY), RunDirectory(tmp_path / "run")
    run_experiment(config, run)
    assert [name for name, *_ in calls] == ["collect", "evaluate", "print"]
    assert calls[1][1].nfe == (1, 2, 3)
    assert run.status()["state"] == DONE
    assert run.config() == with_robot(config)
    assert run.weight_steps() == [2, 4]
    assert [row["step"] for row in read_metrics(run.metrics)] == [1, 2, 3, 4]
    described = json.loads(run.policy_weights().with_suffix(".json").read_text())
    assert {"step", "seed", "data", "precision", "fingerprint"} <= described.keys()
    assert described["config"] == run.config()
    assert described["fingerprint"]["threads"] == 1

    files = {path: path.stat().st_mtime_ns for path in run.path.rglob("*") if path.name != ".lock"}
    calls.clear()
    run_experiment(config, run)
    assert [name for name, *_ in calls] == ["evaluate", "print"]
    assert {path: path.stat().st_mtime_ns for path in run.path.rglob("*") if path.name != ".lock"} == files


def test_resumes_where_it_was_stopped(calls, tmp_path, monkeypatch):
    config = compose("train", TINY)
    whole, stopped = RunDirectory(tmp_path / "whole"), RunDirectory(tmp_path / "stopped")
    run_experiment(config, whole)
    original = experiment.Trainer._update

    def interrupted(trainer, batch):
        if trainer.step == 3:
            raise KeyboardInterrupt
        return original(trainer, batch)

    with monkeypatch.context() as patched:
        patched.setattr(experiment.Trainer, "_update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_experiment(config, stopped)
    assert stopped.status()["state"] == FAILED
    run_experiment(config, stopped)
    for step in (2, 4):
        one, other = load_policy(whole, step).state_dict(), load_policy(stopped, step).state_dict()
        assert all(torch.equal(one[name], other[name]) for name in one)


def test_execution_keys_may_change_and_others_may_not(calls, tmp_path):
    run = RunDirectory(tmp_path)
    run_experiment(compose("train", TINY), run)
    run_experiment(compose("train", [*TINY, "evaluation.episodes=7", "training.log_every=5"]), run)
    assert calls[-2][1].episodes == 7
    with pytest.raises(UserError, match=r"another config: seed was 0, is 1\. Choose another name"):
        run_experiment(compose("train", [*TINY, "seed=1"]), run)
    assert run.status()["state"] == DONE


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("horizon.exec=64", r"horizon\.exec must not exceed horizon\.pred"),
        ("training.steps=0", r"training\.steps must be between 1"),
        ("training.steps=many", r"training\.steps must be a whole number, found 'many'"),
        ("training.sharding=full", r"training\.sharding=full needs several processes, found one"),
        ("optim.lr=-1", r"optim\.lr must be above 0"),
        ("evaluation.nfe=fast", r"evaluation\.nfe must be a list"),
        ("evaluation.nfe=[]", r"evaluation\.nfe must be one or more values, each at least 1"),
        ("evaluation.nfe=[1,0]", r"evaluation\.nfe must be .* at least 1, found \[1, 0\]"),
        ("evaluation.episodes=0", r"evaluation\.episodes must be between 1 and"),
        ("core=block_attnres core.residual.block_size=9", r"block_size .* 8 sublayers of the core, found 9"),
        ("generator=act core=act evaluation.nfe=[3]", r"must be 1 with generator=act .*, found 3"),
        ("core=act", r"generator .*MeanFlow drives .* core .*ActCore is of the kind"),
        ("generator.parametrisation=x", r"generator\.parametrisation must be data or velocity"),
        ("evaluation.device=gpu", r"evaluation\.device must be one of cpu, cuda, found 'gpu'"),
        ("evaluation.device=cuda", r"evaluation\.device must be cpu, as torch finds no CUDA device"),
        ("training.device=cuda", r"training\.device is cuda, but torch finds no CUDA device"),
        ("evaluation.workers=-1", r"evaluation\.workers must be null or between 0 and"),
        ("evaluation.episode_timeout_s=-1", r"evaluation\.episode_timeout_s must be null or above 0"),
        ("evaluation.noise_seed=-1", r"evaluation\.noise_seed must be between 0 and"),
        (
            "evaluation.first_seed=18446744073709551616",
            r"evaluation\.first_seed must be a whole number up to",
        ),
        ("evaluation.checkpoint=3", r"checkpoint must be one of the weights .* of the steps 2, 4, found 3"),
        ("evaluation.checkpoint=half", r"evaluation\.checkpoint must be last, a training step"),
        ("augmentation.brightness=9", r"augmentation\.brightness must be at most 1"),
        ("observation.views=[]", r"observation\.views must be one or more views"),
        ("task.paraphrases=often", r"task\.paraphrases must be true or false"),
        ("generator.clip=nan", r"generator\.clip must be a finite number, found nan"),
        ("generator.boundary_share=2", r"generator\.boundary_share must be between 0 and 1"),
        ("core.heads=many", r"core\.heads must be a whole number, found 'many'"),
        ("core.width=1000000000000", r"width must be at most 1000000"),
        ("generator.adaptive_offset=1e-40 generator.adaptive_power=9", r"generator must be finite, found"),
        ("~evaluation", r"Missing key evaluation"),
        ("seed=-1", r"seed must be between 0 and"),
    ],
)
def test_bad_values_are_reported_before_anything_is_written(calls, tmp_path, override, message):
    with pytest.raises(UserError, match=message):
        run_experiment(compose("train", [*TINY, *override.split()]), RunDirectory(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    assert calls == []


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.expert.modes=3", r"task\.expert\.modes must be 1, 2 or 4"),
        ("task.variant=odd", r"task\.variant must be one of easy, default, hard"),
        ("observation.views=[front,back]", r"There is no view 'back'"),
        ("demos.workers=-1", r"demos\.workers must be null or between 0"),
    ],
)
def test_demonstrations_that_cannot_be_recorded_are_reported_early_too(calls, tmp_path, override, message):
    with pytest.raises(UserError, match=message):
        run_experiment(compose("train", [*TINY, override]), RunDirectory(tmp_path / "run"))
    assert calls == []


@pytest.mark.parametrize("checkpoint", ["2", "'2'", "1/2", "last"])
def test_weights_to_evaluate_are_a_step_a_share_or_the_last(calls, tmp_path, checkpoint):
    config, run = compose("train", [*TINY, f"evaluation.checkpoint={checkpoint}"]), RunDirectory(tmp_path)
    run_experiment(config, run)
    assert run.weights_step(calls[1][1].checkpoint) == (4 if checkpoint == "last" else 2)


def test_failure_is_in_the_status(calls, tmp_path, monkeypatch):
    def fail(config):
        raise UserError("no demonstrations were found.")

    monkeypatch.setattr(experiment, "open_source", fail)
    run = RunDirectory(tmp_path)
    with pytest.raises(UserError, match="no demonstrations"):
        run_experiment(compose("train", TINY), run)
    status = run.status()
    assert status["state"] == FAILED
    assert status["error"] == "no demonstrations were found."
    assert "Traceback" in status["traceback"]


def test_weights_of_another_method_are_refused(calls, tmp_path):
    run = RunDirectory(tmp_path)
    run_experiment(compose("train", TINY), run)
    config = run.config()
    config["core"]["depth"] += 1
    (run.path / "config.yaml").write_text(yaml.safe_dump(config))
    with pytest.raises(UserError, match=r"config\.yaml is not what .* trained with: core\.depth was 4, is 5"):
        load_policy(run)
    run.policy_weights().with_suffix(".json").unlink()  # weights that do not say what they are
    with pytest.raises(
        UserError, match=r"policy\.safetensors does not fit the configured policy: missing core"
    ):
        load_policy(run)


def test_an_nfe_that_the_generator_does_not_support_is_reported_before_anything_is_done(calls, tmp_path):
    run = RunDirectory(tmp_path / "run")
    with pytest.raises(UserError, match="nfe"):
        run_experiment(compose("train", [*TINY, "generator=l1"]), run)
    assert calls == []
    assert not run.status()


def test_a_device_that_cannot_draw_is_reported_before_anything_is_done(calls, tmp_path, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("MUJOCO_EGL_DEVICE_ID", "GPU-1234")
    run = RunDirectory(tmp_path / "run")
    with pytest.raises(UserError, match="MUJOCO_EGL_DEVICE_ID"):
        run_experiment(compose("train", TINY), run)
    assert calls == []
    assert not run.status()


def test_pretrained_weights_are_read_where_a_training_begins_and_never_again(calls, tmp_path, monkeypatch):
    read = []
    monkeypatch.setattr(experiment, "initialise_from_pretrained", read.append)
    original = experiment.Trainer._update

    def interrupted(trainer, batch):
        if trainer.step == 3:
            raise KeyboardInterrupt
        return original(trainer, batch)

    config, run = compose("train", TINY), RunDirectory(tmp_path / "run")
    with monkeypatch.context() as patched:
        patched.setattr(experiment.Trainer, "_update", interrupted)
        with pytest.raises(KeyboardInterrupt):
            run_experiment(config, run)
    assert len(read) == 2  # to find early what does not fit, and to train
    run_experiment(config, run)
    run.last_state.unlink()
    run_experiment(config, run)
    assert run.status()["state"] == DONE
    assert len(read) == 2


def test_foreign_weights_are_reported_before_anything_is_written(calls, tmp_path):
    overrides = ["encoder=resnet18", f"encoder.vision.pretrained={tmp_path}/resnet18.pth"]
    with pytest.raises(UserError, match=r"encoder\.vision\.pretrained must be null or a \.safetensors file"):
        run_experiment(compose("train", [*TINY, *overrides]), RunDirectory(tmp_path / "run"))
    assert not (tmp_path / "run").exists()
    assert calls == []


def test_an_environment_that_is_refused_is_closed(monkeypatch):
    config = compose("train", ["+exp=socket_act"])
    config["task"]["kind"] = "gymnasium"
    env = FakeEnvironment()
    closed = []
    monkeypatch.setattr(env, "close", lambda: closed.append(env), raising=False)
    monkeypatch.setattr(experiment, "environment_of", lambda config: env)

    def refuse(*robots, **words):
        raise UserError("other robots")

    monkeypatch.setattr(experiment, "refuse_other_robot", refuse)
    monkeypatch.setattr(experiment, "robot_of", lambda config: None)
    with pytest.raises(UserError, match="other robots"):
        experiment._check_environment(config)
    assert closed == [env]
