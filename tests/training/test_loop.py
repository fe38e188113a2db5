import json
import math
import os
import signal
import subprocess
import sys
import textwrap
from contextlib import nullcontext
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from safetensors import safe_open
from tiny_policy import ACTION, OPTIM, OPTIONS, STATE, STEPS, CountedBatches, TinyPolicy
from torch import nn

from imfvla.errors import UserError
from imfvla.generators.base import HighNoiseTimes
from imfvla.generators.staged import StagedMeanFlow
from imfvla.nn.residual import StandardResidual
from imfvla.nn.transformer import TransformerCore
from imfvla.process.signals import Stopped
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.logger import read_metrics
from imfvla.training.loop import Trainer, choose_device, step_seed

TIMES = {"steps_per_s", "data_wait_fraction", "train_s"}


class Killed(BaseException):
    """Imitates SIGKILL: nothing catches it."""


class DiesAt(TinyPolicy):
    """Raises at the forward pass of a step (0-based), counted within the process."""

    def __init__(self, calls: int, error: BaseException) -> None:
        super().__init__()
        self.calls, self.error = calls, error

    def loss(self, batch, rng):
        if self.calls == 0:
            raise self.error
        self.calls -= 1
        return super().loss(batch, rng)


class StagedPolicy(nn.Module):
    """Mean Flow in two stages, of which the second one begins at half-time."""

    def __init__(self, dies_at: int | None = None) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.core = TransformerCore(
            steps=STEPS, channels=ACTION, width=8, depth=1, heads=2, patch=1, mlp_ratio=2.0, max_rad=10.0,
            residual=StandardResidual, velocity_head=True,
        )  # fmt: skip
        self.encoder = nn.Linear(STATE, 8)
        self.generator = StagedMeanFlow(
            parametrisation="data", times=HighNoiseTimes(), velocity_head=True, average_from=0.5, path_steps=2,
            boundary_share=0.5, time_power=2.0, adaptive_power=0.5, adaptive_offset=1e-3, draws=2, clip=10.0,
        )  # fmt: skip
        self.dies_at = dies_at

    def spans(self, steps):
        return {name: self.generator.span(name, steps) for name, _ in self.named_parameters()}

    def begin_step(self, step, steps):
        self.generator.begin_step(self.core, step, steps)
        if step == self.dies_at and not self.training:  # the average, which is told last
            raise Killed()

    def loss(self, batch, rng):
        context = self.core.condition(self.encoder(batch.obs.state))
        loss, logs = self.generator.loss(self.core, context, batch.actions, batch.valid, rng)
        return loss.mean(), logs


def tensors_of(path: Path) -> dict[str, torch.Tensor]:
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118


def details_of(path: Path) -> dict:
    with safe_open(path, framework="pt") as file:
        details = json.loads(file.metadata()["details"])
    del details["train_s"]
    return details


def untimed_metrics(run) -> list[dict]:
    return [
        {key: value for key, value in row.items() if key not in TIMES} for row in read_metrics(run.metrics)
    ]


def assert_same_run(one, other):
    """Weights, average, moments, counters and metrics are equal bit for bit."""
    details = [details_of(run.last_state) for run in (one, other)]
    for found in details:  # somebody may edit a file in the meantime
        found.pop("earlier_code", None)
        del found["code"]
    assert details[0] == details[1]
    paths = [one.last_state, *(one.policy_weights(step) for step in one.weight_steps())]
    others = [other.last_state, *(other.policy_weights(step) for step in other.weight_steps())]
    assert len(paths) == len(others) == 3
    for path, counterpart in zip(paths, others, strict=True):
        tensors, expected = tensors_of(path), tensors_of(counterpart)
        assert tensors.keys() == expected.keys()
        assert all(torch.equal(tensors[name], expected[name]) for name in tensors)
    assert untimed_metrics(one) == untimed_metrics(other)


@pytest.mark.parametrize("killed_at", [1, 2, 3])
def test_resume_equals_uninterrupted_bit_for_bit(tmp_path, make_trainer, killed_at):
    whole = make_trainer(tmp_path / "whole")
    whole.train()
    with pytest.raises(Killed):
        make_trainer(tmp_path / "resumed", DiesAt(killed_at, Killed())).train()
    resumed = make_trainer(tmp_path / "resumed")
    assert resumed.step == killed_at
    resumed.train()
    assert_same_run(whole.run, resumed.run)


@pytest.mark.parametrize("killed_at", [1, 2, 3])
def test_resume_across_the_start_of_a_stage_equals_uninterrupted_bit_for_bit(
    tmp_path, make_trainer, killed_at
):
    """Its blocks take the weights of others before step 2, in the policy and in the average of its weights."""
    whole = make_trainer(tmp_path / "whole", StagedPolicy())
    whole.train()
    with pytest.raises(Killed):
        make_trainer(tmp_path / "resumed", StagedPolicy(dies_at=killed_at)).train()
    resumed = make_trainer(tmp_path / "resumed", StagedPolicy())
    assert resumed.step == killed_at
    resumed.train()
    assert_same_run(whole.run, resumed.run)


def test_the_average_of_the_weights_starts_a_stage_from_its_own(tmp_path, make_trainer):
    trainer = make_trainer(tmp_path, StagedPolicy(dies_at=2))
    with pytest.raises(Killed):
        trainer.train()
    learned, averaged = trainer.policy.core, trainer.ema.policy.core
    for core in (learned, averaged):
        assert torch.equal(core.average.output.weight, core.output.weight)
    assert torch.equal(learned.output.weight, averaged.output.weight)


def test_what_no_longer_learns_stays_as_its_average(tmp_path, make_trainer):
    """The first stage ends before step 2 of 4; only the blocks of the average velocity change afterwards."""
    states = []
    for dies_at in (2, None):
        trainer = make_trainer(tmp_path / str(dies_at), StagedPolicy(dies_at=dies_at))
        with nullcontext() if dies_at is None else pytest.raises(Killed):
            trainer.train()
        states.append({name: p.detach().clone() for name, p in trainer.ema.policy.named_parameters()})
    changed = {name for name, before in states[0].items() if not torch.equal(before, states[1][name])}
    assert changed
    assert all(name.startswith("core.average.") for name in changed)


def test_resume_from_an_older_state_repeats_no_row(tmp_path, make_trainer):
    """The state is older than the last row and the last weights: both are made again."""
    whole = make_trainer(tmp_path / "whole", log_every=1)
    whole.train()
    with pytest.raises(Killed):
        make_trainer(tmp_path / "resumed", DiesAt(3, Killed()), log_every=1, save_every_s=1e9).train()
    resumed = make_trainer(tmp_path / "resumed", log_every=1)
    assert resumed.step == 2  # saved with the weights of half-time
    assert [row["step"] for row in read_metrics(resumed.run.metrics)] == [1, 2, 3]
    resumed.train()
    assert_same_run(whole.run, resumed.run)


def test_resumes_after_sigkill(tmp_path, make_trainer):
    script = textwrap.dedent(
        """
        import os, signal, sys
        sys.path.insert(0, sys.argv[2])
        from tiny_policy import CountedBatches, OPTIM, OPTIONS, TinyPolicy
        from imfvla.storage.run_directory import RunDirectory
        from imfvla.training.loop import Trainer

        class Dies(TinyPolicy):
            calls = 0
            def loss(self, batch, rng):
                self.calls += 1
                if self.calls == 3:
                    os.kill(os.getpid(), signal.SIGKILL)
                return super().loss(batch, rng)

        run = RunDirectory(sys.argv[1])
        Trainer(Dies(), CountedBatches(), run, OPTIONS, OPTIM, seed=7, description={}).train()
        """
    )
    command = [sys.executable, "-c", script, str(tmp_path / "killed"), str(Path(__file__).parent)]
    assert subprocess.run(command, check=False).returncode == -signal.SIGKILL
    whole, resumed = make_trainer(tmp_path / "whole"), make_trainer(tmp_path / "killed")
    assert resumed.step == 2
    whole.train()
    resumed.train()
    assert_same_run(whole.run, resumed.run)


def test_other_code_is_said_and_kept_where_a_training_resumes(tmp_path, make_trainer, monkeypatch, caplog):
    old = {"version": "0", "commit": "a" * 40, "dirty": False, "changes": None}
    new = old | {"dirty": True, "changes": "12"}
    for dies_at, code in ((1, old), (1, new), (None, new)):
        monkeypatch.setattr("imfvla.training.origin.code_version", lambda code=code: code)
        policy = None if dies_at is None else DiesAt(dies_at, Killed())
        with nullcontext() if dies_at is None else pytest.raises(Killed):
            make_trainer(tmp_path, policy).train()
    assert (
        caplog.text.count("resuming with other code: was aaaaaaaaaaaa, is aaaaaaaaaaaa with changes 12") == 1
    )
    run = make_trainer(tmp_path).run
    earlier = [{"until_step": 1, "code": old}]
    details = details_of(run.last_state)
    assert (details["code"], details["earlier_code"]) == (new, earlier)
    assert json.loads((run.weights_directory(4) / "policy.json").read_text())["earlier_code"] == earlier


def test_a_training_does_not_resume_with_another_config(tmp_path, make_trainer):
    def trainer(rate: float, dies_at: int | None = None) -> Trainer:
        policy = TinyPolicy() if dies_at is None else DiesAt(dies_at, Killed())
        config = {"optim": {"lr": rate}, "training": {"threads": dies_at}}
        options = (CountedBatches(), RunDirectory(tmp_path), OPTIONS, OPTIM)
        return Trainer(policy, *options, seed=7, description={"config": config})

    with pytest.raises(Killed):
        trainer(0.1, dies_at=2).train()
    with pytest.raises(
        UserError, match=r"state\.safetensors was saved with another config: optim\.lr was 0\.1, is 0\.2"
    ):
        trainer(0.2)
    assert trainer(0.1).step == 2


def test_finished_run_does_nothing(tmp_path, make_trainer):
    make_trainer(tmp_path).train()
    trainer = make_trainer(tmp_path, DiesAt(0, Killed()))
    before = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")}
    assert trainer.is_finished
    trainer.train()
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*")} == before


def test_keeps_weights_at_shares_of_the_steps(tmp_path, make_trainer):
    trainer = make_trainer(tmp_path, steps=7, checkpoints=3)
    trainer.train()
    assert trainer.run.weight_steps() == [2, 5, 7]
    described = json.loads(trainer.run.policy_weights(7).with_suffix(".json").read_text())
    assert described["step"] == 7
    kept = tensors_of(trainer.run.policy_weights("last"))
    assert all(torch.equal(kept[name], value) for name, value in trainer.ema.policy.state_dict().items())


@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_stops_where_loss_or_gradient_is_not_finite(tmp_path, make_trainer, where):
    class Diverges(TinyPolicy):
        calls = 0

        def loss(self, batch, rng):
            self.calls += 1
            loss, logs = super().loss(batch, rng)
            if self.calls < 3:
                return loss, logs
            # the square root's slope at 0 is infinite: a finite loss with a gradient that is not
            return (loss * torch.nan if where == "loss" else loss + (0 * loss).sqrt()), logs

    with pytest.raises(UserError, match=r"step 3, batch 2: .* is nan; the state of step 2 is kept"):
        make_trainer(tmp_path, Diverges()).train()
    trainer = make_trainer(tmp_path)
    assert trainer.step == 2
    assert all(tensor.isfinite().all() for tensor in trainer.policy.state_dict().values())


def test_what_is_not_finite_is_traced_to_its_row(tmp_path, make_trainer):
    class OneBadRow(CountedBatches):
        def batch(self, number):
            batch = super().batch(number)
            if number == 2:
                batch.actions[5, 0, 0] = torch.inf
            return batch

    trainer = make_trainer(tmp_path)
    trainer.batches = OneBadRow()
    with pytest.raises(UserError, match=r"step 3, batch 2: .* It comes from batch-2\.mcap, step 5\. Lower"):
        trainer.train()


def test_a_batch_that_is_not_finite_is_left_out_where_that_is_configured(tmp_path, make_trainer, caplog):
    class Diverges(TinyPolicy):
        bad = True

        def loss(self, batch, rng):
            loss, logs = super().loss(batch, rng)
            return (loss * torch.nan if trainer.step == 2 else loss), logs

    trainer = make_trainer(tmp_path, Diverges(), on_non_finite="skip")
    trainer.train()
    rows = read_metrics(trainer.run.metrics)
    assert [row.get("skipped") for row in rows] == [1, None]
    assert all(math.isfinite(row["loss"]) for row in rows)
    assert all(tensor.isfinite().all() for tensor in trainer.policy.state_dict().values())
    assert "Skipped at step 3, batch 2: the loss is nan" in caplog.text


class BadBatch(CountedBatches):
    """A row of batch `bad` is not finite."""

    def __init__(self, bad: int) -> None:
        super().__init__()
        self.bad = bad

    def batch(self, number):
        batch = super().batch(number)
        if number == self.bad:
            batch.actions[5, 0, 0] = torch.inf
        return batch


LATE = {
    "steps": 8,
    "save_every_s": 1e9,
    "checkpoints": 1,
}  # only rows of the log, and stages, read what was measured


@pytest.mark.parametrize("bad", [0, 2, 3, 4, 6])  # the second stage begins at step 4
def test_a_bad_batch_is_named_at_the_next_row_with_the_weights_that_it_was_found_with(
    tmp_path, make_trainer, bad
):
    sound = make_trainer(tmp_path / "sound", StagedPolicy(), **LATE, log_every=8)
    for _ in range(bad):
        sound._update(next(sound.batches))
    found = make_trainer(tmp_path / "found", StagedPolicy(), **LATE, log_every=8)
    found.batches = BadBatch(bad)
    where = rf"step {bad + 1}, batch {bad}: .* It comes from batch-{bad}\.mcap, step 5\. Lower"
    with pytest.raises(UserError, match=where):
        found.train()
    assert found.step == (4 if bad < 4 else 8)
    if bad != 4:  # where the blocks of the second stage begin with the weights of the first
        for own, expected in zip(found.policy.parameters(), sound.policy.parameters(), strict=True):
            assert torch.equal(own, expected)


@pytest.mark.parametrize("bad", [0, 2, 3, 4, 6, 7])
def test_when_a_skipped_batch_is_noticed_changes_nothing(tmp_path, make_trainer, bad):
    trained = []
    for log_every in (1, 8):
        trainer = make_trainer(
            tmp_path / str(log_every), StagedPolicy(), **LATE, log_every=log_every, on_non_finite="skip"
        )
        trainer.batches = BadBatch(bad)
        trainer.train()
        assert sum(row.get("skipped", 0) for row in read_metrics(trainer.run.metrics)) == 1
        trained.append([*trainer.policy.parameters(), *trainer.ema.policy.parameters()])
    assert all(torch.equal(*pair) for pair in zip(*trained, strict=True))


def test_too_many_skipped_batches_in_a_row_stop_the_run(tmp_path, make_trainer):
    class Hopeless(TinyPolicy):
        def loss(self, batch, rng):
            loss, logs = super().loss(batch, rng)
            return loss * torch.nan, logs

    with pytest.raises(UserError, match=r"step 11, .*11 batches in a row"):
        make_trainer(tmp_path, Hopeless(), on_non_finite="skip", steps=20).train()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_request_to_stop_saves_the_step_and_resumes_bit_for_bit(tmp_path, make_trainer, number):
    class Asked(TinyPolicy):
        def loss(self, batch, rng):
            if trainer.step == 1:
                os.kill(os.getpid(), number)
            return super().loss(batch, rng)

    whole = make_trainer(tmp_path / "whole")
    whole.train()
    before = signal.getsignal(number)
    trainer = make_trainer(tmp_path / "stopped", Asked(), save_every_s=1e9)
    with pytest.raises(Stopped) as stop:
        trainer.train()
    assert stop.value.exit_code == 128 + number
    assert signal.getsignal(number) is before
    resumed = make_trainer(tmp_path / "stopped")
    assert resumed.step == 2
    resumed.train()
    assert_same_run(whole.run, resumed.run)


def test_weights_that_a_kill_prevented_are_saved_on_resuming(tmp_path, make_trainer):
    make_trainer(tmp_path).train()
    trainer = make_trainer(tmp_path)
    for path in trainer.run.weights_directory(4).iterdir():
        path.unlink()
    trainer.run.weights_directory(4).rmdir()
    assert trainer.is_finished
    trainer.train()
    kept = tensors_of(trainer.run.policy_weights(4))
    assert all(torch.equal(kept[name], value) for name, value in trainer.ema.policy.state_dict().items())


def test_closes_the_batches(tmp_path, make_trainer):
    trainer = make_trainer(tmp_path, DiesAt(0, Killed()))
    with pytest.raises(Killed):
        trainer.train()
    assert trainer.batches.closed


def test_bf16_trains(tmp_path, make_trainer):
    trainer = make_trainer(tmp_path, precision="bf16")
    trainer.train()
    assert details_of(trainer.run.last_state)["precision"] == "bf16"
    assert {parameter.dtype for parameter in trainer.policy.parameters()} == {torch.float32}


def test_metrics_have_the_documented_columns(tmp_path, make_trainer):
    trainer = make_trainer(tmp_path)
    trainer.train()
    rows = read_metrics(trainer.run.metrics)
    assert [row["step"] for row in rows] == [3, 4]
    assert set(rows[0]) == {"step", "loss", "error", "grad_norm", "clipped", "lr", *TIMES}
    assert list(trainer.run.tensorboard.glob("events.*"))


def test_steps_have_seeds_of_their_own():
    assert len({step_seed(seed, step) for seed in range(3) for step in range(100)}) == 300


def test_cuda_without_a_device_is_refused(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert choose_device("auto").type == "cpu"
    with pytest.raises(UserError, match=r"training\.device is cuda"):
        choose_device("cuda")


READS = ("item", "tolist", "cpu", "numpy", "__bool__", "__float__", "__int__", "nonzero")


@pytest.fixture
def reads(monkeypatch) -> list[str]:
    """Every read of a tensor's values on a CPU, since on a GPU each of them would wait."""
    found = []
    for name in READS:
        was = getattr(torch.Tensor, name)
        monkeypatch.setattr(
            torch.Tensor, name, lambda *args, was=was, name=name: found.append(name) or was(*args)
        )
    return found


def test_nothing_waits_for_an_accelerator_between_two_rows_of_the_log(tmp_path, make_trainer, reads):
    class Batches(CountedBatches):
        def __next__(self):
            batch = super().__next__()
            at_step.append(len(reads))
            return batch

    at_step = []
    trainer = make_trainer(tmp_path, steps=10, log_every=5, checkpoints=1, save_every_s=1e9)
    trainer.batches = Batches()
    trainer.train()
    since = [after - before for before, after in pairwise([*at_step, len(reads)])]
    assert [count > 0 for count in since] == [False, False, False, False, True] * 2
    assert since[4] == 1
