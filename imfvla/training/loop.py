"""The training loop: any policy with a loss, batches that are a function of their number, a run directory.

Step i (0-based) takes batch i, random numbers of SeedSequence([seed, stream, i]) and the learning rate of i.
So the state to resume from is the weights, their average, AdamW's moments and the gradients' scale, and a resumed run
equals an uninterrupted one bit for bit (same machine, same number of threads).
"""

import logging
import math
import time
from collections.abc import Mapping
from contextlib import closing
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn

from imfvla.draws import Stream
from imfvla.errors import UserError
from imfvla.process.progress import Progress
from imfvla.process.signals import Stopped, deferred_stop
from imfvla.storage.fingerprint import fingerprint, physical_cores
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.accumulation import add_gradients
from imfvla.training.checkpoint import save_weights
from imfvla.training.clipping import Clipping
from imfvla.training.compiling import EAGER, Compiling
from imfvla.training.ema import Ema
from imfvla.training.logger import MetricsLogger, SilentLogger
from imfvla.training.non_finite import NonFinite, name_cause
from imfvla.training.optimiser import make_optimiser
from imfvla.training.options import FULL, OptimOptions, TrainingOptions
from imfvla.training.origin import Origin
from imfvla.training.parallel import Alone
from imfvla.training.precision import PRECISIONS, allow_tf32, choose_precision
from imfvla.training.schedule import learning_rate
from imfvla.training.sharding import shard, whole
from imfvla.training.spans import Span, Spans
from imfvla.training.train_state import TrainState, load_state, save_state
from imfvla.training.transfer import Sent, Transfer
from imfvla.training.unread import Unread
from imfvla.types import Batch

LOSS_STREAM = 1  # of the random numbers that a policy's loss draws
log = logging.getLogger(__name__)


class Trainable(Protocol):
    """What the loop asks of a policy, which is also an nn.Module."""

    def spans(self, steps: int) -> Spans: ...
    def begin_step(self, step: int, steps: int) -> None: ...
    def loss(self, batch: Batch, rng: Stream) -> tuple[Tensor, dict[str, Tensor]]: ...


class Batches(Protocol):
    """Endless batches with a state, such as `imfvla.data.Loader`."""

    def __next__(self) -> Batch | Sent: ...
    def batch(self, number: int) -> Batch: ...  # once more
    def describe(self, number: int) -> list[str]: ...  # episode and step of each row of batch `number`
    def state_dict(self) -> dict[str, Any]: ...
    def load_state_dict(self, state: dict[str, Any]) -> None: ...
    def close(self) -> None: ...


class Trainer:
    """Trains `policy` in `run` up to `options.steps`, from the saved state if there is one.

    `batches` begins at batch 0 and is closed at the end. `description` (JSON-able) goes beside the weights.
    """

    def __init__(
        self,
        policy: nn.Module,
        batches: Batches,
        run: RunDirectory,
        options: TrainingOptions,
        optim: OptimOptions,
        *,
        seed: int,
        description: Mapping[str, Any],
        processes: Alone | None = None,  # those that share every batch; None for a single process
    ) -> None:
        self.processes = processes or Alone()
        self.processes.check(options)
        torch.set_num_threads(options.threads or max(1, physical_cores() // self.processes.local_size))
        self.device = choose_device(options.device)
        self.policy = policy.to(self.device)
        self.batches, self.run, self.options, self.optim = batches, run, options, optim
        self.transfer = Transfer(self.processes, self.device)
        self.transfer.attach(batches)
        self.seed, self.description = seed, dict(description)
        self.processes.begin_alike(self.policy)
        spans = self.policy.spans(options.steps)
        self.ema = Ema(self.policy, optim.ema_decay, spans)
        if options.sharding == FULL:
            shard(self.policy, self.device, loss="loss")
            shard(self.ema.policy, self.device)
        self.optimiser = make_optimiser(self.policy, optim, spans)
        self.state = TrainState(self.policy, self.ema.policy, self.optimiser)
        self.step = self.saved_step = 0
        self.train_s = 0.0  # spent in this process and earlier ones
        self._logger_state: dict[str, Any] | None = None
        self.unread = Unread()
        self.origin = Origin(self.description.get("config"))
        precision: str | None = None
        compiling: str | None = None
        gradient_scale: float | None = None
        if run.last_state.exists():
            details = load_state(run.last_state, self.state)
            self.origin.resume(details, run.last_state)
            self.step = self.saved_step = details["step"]
            self.train_s, self._logger_state = details["train_s"], details["logger"]
            precision, gradient_scale = details["precision"], details["gradient_scale"]
            compiling = details.get("compiling", EAGER)  # states without it are older than auto
            batches.load_state_dict(details["batches"])
            log.info(f"resuming at step {self.step} of {options.steps} from {run.last_state}")
        precision = precision or choose_precision(options.precision, self.device)
        self.precision = self.processes.first_of(PRECISIONS, precision)
        allow_tf32(self.precision)
        self.clipping = Clipping(optim.clip_factor, optim.clip_norm, gradient_scale, self.device)
        self.non_finite = NonFinite(options.on_non_finite)
        self._goes_on = torch.ones((), dtype=torch.bool, device=self.device)
        self._boundaries = {step for span in spans.values() for step in span}
        self._loss: float | None = None  # as last read
        self.compiling = Compiling(options, self.policy, self.device, self.processes, compiling)

    @property
    def is_finished(self) -> bool:
        return self.step >= self.options.steps

    def train(self) -> None:
        """Runs the remaining steps; at a request to stop it saves the state and raises `Stopped`.

        Raises UserError on a non-finite loss or gradient, and on a full disk.
        """
        lacking = self.step in self.options.checkpoint_steps() and self.step not in self.run.weight_steps()
        if any(self.processes.highest([lacking])):
            self._save_weights()  # a kill came between saving the state and the weights
        if self.is_finished:
            return
        self.policy.train()
        kind = MetricsLogger if self.processes.is_first else SilentLogger
        logger = kind(self.run, self.step, self._logger_state)
        with (
            deferred_stop() as self._stop,
            closing(self.batches),
            closing(self.compiling),
            closing(logger),
            Progress(
                "training", self.options.steps, done=self.step, shown=self.processes.is_first
            ) as progress,
        ):
            self._loop(logger, progress)

    def _loop(self, logger: MetricsLogger, progress: Progress) -> None:
        keep_weights = self.options.checkpoint_steps()
        start = interval_start = last_save = time.perf_counter()
        spent_before, first_step, interval_step, waited = self.train_s, self.step, self.step, 0.0
        while not self.is_finished:
            before = time.perf_counter()
            batch = next(self.batches)
            received = time.perf_counter()
            waited += received - before
            if self.step in self._boundaries:
                self._read(logger)  # with the weights of the stage that ends
            self._update(batch)
            self.compiling.took(time.perf_counter() - received, self.step)
            row_is_due = self.step % self.options.log_every == 0 or self.is_finished
            if row_is_due:
                self._read(logger)
            now = time.perf_counter()
            self.train_s = spent_before + now - start
            rate = (self.step - first_step) / (now - start)
            loss = "" if self._loss is None else f"loss {self._loss:.4f}  "
            progress.advance(f"{loss}{rate:.2f} steps/s")
            if row_is_due:
                seconds = now - interval_start
                rate = (self.step - interval_step) / seconds
                logger.write(
                    self.step, steps_per_s=rate, data_wait_fraction=waited / seconds, train_s=self.train_s
                )
                interval_start, interval_step, waited = now, self.step, 0.0
            due = self.step in keep_weights or now - last_save >= self.options.save_every_s
            stop, due = self.processes.highest([self._stop.number or 0, due])  # clocks differ
            if stop or due:
                self._save_state(logger)
                last_save = time.perf_counter()
            if self.step in keep_weights:  # after the state: the last weights show that everything is saved
                self._save_weights()
            if stop:
                log.info(
                    f"asked to stop: the state of step {self.step} is saved, rerun the same command to resume"
                )
                raise Stopped(stop)

    def _update(self, batch: Batch | Sent) -> None:
        """One step of the optimiser over all processes.

        None where loss or gradient is not finite; where that is to stop the training, none after it either.
        """
        for group in self.optimiser.param_groups:
            group["lr"] = self._rate(group["span"])
        self.ema.settle(self.step)
        share = self.transfer.receive(batch)
        for policy in (self.policy, self.ema.policy):
            policy.begin_step(self.step, self.options.steps)
        self.optimiser.zero_grad(set_to_none=True)
        loss, logs = add_gradients(
            self.policy,
            share,
            self.options.accumulate,
            seed=step_seed(self.seed, self.step),
            precision=self.precision,
            processes=self.processes,
            own_stream=self.compiling.is_one_graph,
        )
        self.processes.average_gradients(self.policy.parameters())
        gradients = [p.grad for p in self.policy.parameters() if p.grad is not None]
        norm = whole(nn.utils.get_total_norm(gradients))
        exact = torch.stack([scalar.detach().to(torch.float64) for scalar in (loss, *logs.values())])
        loss, *means = self.processes.mean(exact)
        takes_part = self._goes_on & loss.isfinite() & norm.isfinite()
        if self.non_finite.stops:
            self._goes_on = takes_part  # until it is read, the weights stay those that it was found with
        clipped = self.clipping.clip(gradients, norm, takes_part)
        self.optimiser.found_inf = (~takes_part).to(torch.float32)  # decides on the device whether it steps
        self.optimiser.step()
        self.ema.update(self.step)
        rate = max(group["lr"] for group in self.optimiser.param_groups)
        measured = {"loss": loss, "grad_norm": norm, "clipped": clipped, "lr": rate}
        self.unread.add(self.step, measured | dict(zip(logs, means, strict=True)))
        self.step += 1

    def _read(self, logger: MetricsLogger) -> None:
        """Logs what the steps since the last reading measured, all of one stage.

        Of what happens in every step or row nothing else waits for a GPU. Raises UserError where a batch that is not
        finite is to stop the training.
        """
        for step, scalars in self.unread.read():
            self._loss = scalars["loss"]
            for what, name in (("loss", "loss"), ("norm of the gradient", "grad_norm")):
                if not math.isfinite(scalars[name]):
                    self._skipped(step, what, scalars[name])
                    logger.skip()
                    break
            else:
                self.non_finite.in_a_row = 0
                logger.add(scalars)

    def _rate(self, span: Span) -> float:
        """The learning rate of this step for parameters that learn in the steps of `span`; 0 in others."""
        first, end = span
        if not first <= self.step < end:
            return 0.0
        return learning_rate(
            int(self.step - first),
            steps=int(min(end, self.options.steps) - first),
            peak=self.optim.lr,
            warmup=self.optim.warmup,
            floor=self.optim.floor,
        )

    def _skipped(self, step: int, what: str, value: float) -> None:
        """Says what step `step` did not learn from. Raises UserError where training is to stop."""
        batch = self.batches.batch(step).to(self.device)
        cause = name_cause(self.policy, batch, step_seed(self.seed, step), self.batches.describe(step))
        kept = (
            f"the state of step {self.saved_step} is kept" if self.saved_step else "no state was saved before"
        )
        self.non_finite.found(what, value, step, cause, f"{kept} in {self.run.path}")

    def _save_weights(self) -> None:
        description = {
            "step": self.step,
            "train_s": round(self.train_s, 1),
            "precision": self.precision,
            "fingerprint": fingerprint(device=str(self.device), threads=torch.get_num_threads()),
            **self.origin.versions(),
            **self.description,
        }
        directory = self.run.weights_directory(self.step)
        save_weights(directory, self.ema.policy, description, writes=self.processes.is_first)

    def _save_state(self, logger: MetricsLogger) -> None:
        self._read(logger)
        logger.sync()  # rows up to this step must outlive it
        self.saved_step = self.step
        details = {
            "step": self.step,
            "train_s": self.train_s,
            "precision": self.precision,
            "compiling": self.compiling.mode,
            "gradient_scale": self.clipping.state(),
            "batches": self.batches.state_dict(),
            "logger": logger.state(),
            **self.origin.to_json(),
        }
        save_state(self.run.last_state, self.state, details, writes=self.processes.is_first)


def step_seed(seed: int, step: int) -> int:
    """Seed of all random numbers that a policy draws at `step`."""
    return int(np.random.SeedSequence([seed, LOSS_STREAM, step]).generate_state(1, np.uint64)[0])


def choose_device(wanted: str) -> torch.device:
    """The device for cpu, cuda or auto. Raises UserError where CUDA is requested and missing."""
    if wanted == "cuda" and not torch.cuda.is_available():
        raise UserError("training.device is cuda, but torch finds no CUDA device: set training.device=cpu.")
    if wanted == "auto":
        wanted = "cuda" if torch.cuda.is_available() else "cpu"
    return torch.device(wanted)
