"""Every experiment trains, resumes and is evaluated on tiny data at scale=cpu, and takes a step at scale=paper."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from any_robot import MemorySource
from synthetic import write_demonstrations

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.config.construction import construct
from imfvla.config.protocol import MEASURED, USUAL, EvaluationOptions
from imfvla.errors import UserError
from imfvla.nn.residual import AttentionResidual
from imfvla.policy import build_policy
from imfvla.reporting.mapping import read_mapping
from imfvla.robot_of import robot_of
from imfvla.rollouts.clock import delay_steps
from imfvla.rollouts.evaluation import evaluate
from imfvla.sources.mcap import McapSource
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy
from imfvla.training.data import make_loader, prepare_windows
from imfvla.training.experiment import read_experiment
from imfvla.training.loop import Trainer
from imfvla.training.optimiser import make_optimiser

EXPERIMENTS = sorted(path.stem for path in (CONFIG_DIRECTORY / "exp").glob("*.yaml"))
YES = {True: "yes", False: "no"}
TINY = [
    "observation.image_size=[32,32]",
    "training.batch_size=2",
    "training.steps=2",
    "training.checkpoints=1",
    "training.save_every_s=0",
    "training.threads=1",
]


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory) -> Path:
    return write_demonstrations(tmp_path_factory.mktemp("recorded") / "demonstrations", num_episodes=2)


def source_of(config: dict, demonstrations: Path):
    """Recordings of the two arms, or drawn episodes of another robot."""
    if "kind" in config["task"]:
        return MemorySource(robot_of(config), num_episodes=2)
    return McapSource.of(demonstrations)


def test_every_row_of_the_tables_has_its_experiment():
    assert {row.experiment for row in read_mapping().rows} <= set(EXPERIMENTS)


def described(row) -> str:
    """The line of docs/design.md on a row of the paper; values at scale=cpu / scale=paper where they differ."""
    cells = []
    for scale in ("cpu", "paper"):
        config = compose("train", [f"+exp={row.experiment}", *row.overrides, f"scale={scale}"])
        with torch.device("meta"):
            encoder = construct(config["encoder"], "encoder", views=3, state_dim=16)
            core = construct(config["core"], "core", channels=16, state_token=-1)
        assert row.nfe in config["evaluation"]["nfe"]
        cells.append(
            (
                type(encoder.vision).__name__,
                encoder.view_tokens.tokens,
                YES[config["encoder"]["vision"].get("residual") == "attention"],
                type(core).__name__,
                f"{config['core']['width']} x {config['core']['depth']}",
                YES[isinstance(getattr(core, "residual", None), AttentionResidual)],
                config["generator"]["_target_"].rpartition(".")[2],
                config["horizon"]["pred"],
                config["horizon"]["exec"],
                config["training"]["steps"],
                row.nfe,
            )
        )
    both = (str(cpu) if cpu == paper else f"{cpu} / {paper}" for cpu, paper in zip(*cells, strict=True))
    return f"| {row.paper.table} | {row.label} | `{row.experiment}` | {' | '.join(both)} |"


@pytest.mark.parametrize("row", [row for row in read_mapping().rows if row.paper], ids=lambda row: row.name)
def test_the_reading_of_each_printed_row_is_that_of_its_config(row):
    assert described(row) in (CONFIG_DIRECTORY.parent / "docs" / "design.md").read_text().splitlines()


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_trains_resumes_and_is_evaluated(experiment, demonstrations, tmp_path, monkeypatch):
    config = compose("train", [f"+exp={experiment}", *TINY, f"demos.frames_directory={tmp_path}/frames"])
    windows = prepare_windows(config, source_of(config, demonstrations))
    run, options = RunDirectory(tmp_path / "run"), read_experiment(config)
    run.claim(config)

    def trainer() -> Trainer:
        torch.manual_seed(0)
        return Trainer(
            build_policy(config, windows.statistics()),
            make_loader(options, windows),
            run,
            options.training,
            options.optim,
            seed=options.seed,
            description={},
        )

    first = trainer()
    before = {name: parameter.detach().clone() for name, parameter in first.policy.named_parameters()}
    take_step = first._update
    monkeypatch.setattr(first, "_update", lambda batch: interrupt() if first.step else take_step(batch))
    with pytest.raises(KeyboardInterrupt):
        first.train()
    second = trainer()
    assert second.step == 1
    second.train()
    after = dict(second.policy.named_parameters())
    assert all(parameter.isfinite().all() for parameter in after.values())
    assert any(not torch.equal(before[name], parameter) for name, parameter in after.items())

    policy = load_policy(run)
    obs = windows.batch(np.arange(2), np.random.default_rng(0)).obs
    noise = torch.randn(2, *policy.noise_shape, generator=torch.Generator().manual_seed(0))
    nfe = config["evaluation"]["nfe"][-1]
    assert torch.equal(policy.predict(obs, noise, nfe), policy.predict(obs, noise, nfe))

    if package := config["task"].get("package"):
        pytest.importorskip(package, reason=f"{package} is not installed")
    few = {"episodes": 1, "first_seed": 0, "workers": 0, "max_steps": 2, "recordings": False}
    (summary,) = evaluate(run, EvaluationOptions(nfe=(config["evaluation"]["nfe"][0],), **few))
    assert summary["checkpoint_step"] == 2
    assert not any(summary["failures"].values())


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_steps_at_the_paper_s_scale(experiment, demonstrations, tmp_path):
    small = compose("train", [f"+exp={experiment}", *TINY, f"demos.frames_directory={tmp_path}/frames"])
    tiny = prepare_windows(small, source_of(small, demonstrations))
    config = compose("train", [f"+exp={experiment}", "scale=paper"])
    options = read_experiment(config)
    policy = build_policy(config, tiny.statistics())
    assert sum(parameter.numel() for parameter in policy.parameters()) > 5e6
    optimiser = make_optimiser(policy, options.optim)
    batch = tiny.batch(np.arange(1), np.random.default_rng(0))
    height, width = config["observation"]["image_size"]
    images = torch.randint(256, (*batch.obs.images.shape[:-2], height, width), dtype=torch.uint8)
    batch = replace(batch, obs=replace(batch.obs, images=images))
    loss, _ = policy.loss(batch, torch.Generator().manual_seed(0))
    loss.backward()
    optimiser.step()
    assert loss.isfinite()
    assert all(parameter.isfinite().all() for parameter in policy.parameters())


def test_exec_beyond_pred_is_refused():
    config = compose("train", ["horizon.pred=8", "horizon.exec=16"])
    with pytest.raises(UserError, match=r"horizon\.exec must not exceed horizon\.pred.*exec=16 and pred=8"):
        build_policy(config)


def test_batches_depend_on_seed_and_number_alone(demonstrations):
    config = compose("train", TINY)
    windows = prepare_windows(config, McapSource.of(demonstrations))
    one, other = (make_loader(read_experiment(config), windows) for _ in range(2))
    next(one)
    other.load_state_dict(one.state_dict())
    first, second = next(one), next(other)
    for loader in (one, other):
        loader.close()
    assert np.array_equal(first.obs.images, second.obs.images)
    assert torch.equal(first.actions, second.actions)


def test_every_setting_of_the_tables_is_one_that_its_row_can_be_evaluated_in():
    """A delay that chunks cover, a prefix that the generator can make, candidates that differ."""
    policies = {}
    for row in (row for row in read_mapping().rows if row.changes):
        key = row.experiment, row.overrides
        if key not in policies:
            policies[key] = build_policy(compose("train", [f"+exp={row.experiment}", *row.overrides]))
        policy, changes = policies[key], USUAL | dict(row.changes)
        if changes["delay_ms"] != MEASURED:
            rate = policy.robot.control_hz
            delay_steps(changes["delay_ms"], rate, policy.horizon, changes["meanwhile"], changes["prefix"])
        policy.check_sampling(row.nfe, changes["noise_scale"], changes["noise"])
        policy.check_replanning(row.nfe, changes["candidates"], changes["prefix"])
    assert policies
