"""Data-parallel training: `torchrun --nproc-per-node=N -m imfvla.train ...`, gloo on CPUs and nccl between GPUs.

N processes compute what one computes, each on its share of the rows of every batch:

- Gradients are averaged explicitly after the backward pass. `DistributedDataParallel` would average them only where
  its own forward is called; a loss that reaches into the policy for a Jacobian-vector product silently bypasses it.
- Random numbers are those of the whole batch: under `Shared.draws`, a draw from the loss's generator is made for
  all rows and reduced to those of this process, so that generators need not know about processes.
- Every process does what follows the average (clipping, the step, the average of the weights). Only process 0 writes.

So the state on disk does not depend on N, and a run can resume with another N.
"""

import importlib
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, fields
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn import functional as F
from torch.overrides import TorchFunctionMode

from imfvla.draws import Stream
from imfvla.errors import UserError
from imfvla.training.options import NONE, TrainingOptions
from imfvla.training.sharding import forget_layouts, is_part
from imfvla.types import Batch, Observation

TIMEOUT = timedelta(days=1)  # others wait while process 0 collects demonstrations
BUCKET = 2**24  # numbers that are averaged at once
DRAWS = (torch.rand, torch.randn, torch.randint)


@dataclass(frozen=True, slots=True)
class Alone:
    """The single process of a training without torchrun; also the base of several."""

    rank: int = 0
    size: int = 1
    local_size: int = 1  # processes on this machine

    @property
    def is_first(self) -> bool:
        """Whether this process writes."""
        return self.rank == 0

    def share(self, batch: Batch) -> Batch:
        """This process's rows of a batch."""
        return batch if self.size == 1 else rows(batch, self._mine(len(batch.actions)))

    def share_of(self, tensor: Tensor) -> Tensor:
        """This process's rows of a tensor that has those of a batch."""
        return tensor[self._mine(len(tensor))]

    def _mine(self, total: int) -> slice:
        count = total // self.size
        return slice(self.rank * count, (self.rank + 1) * count)

    def draws(self, rng: Stream, count: int, part: int = 0, parts: int = 1) -> AbstractContextManager[Any]:
        """Context in which the loss of `count` rows uses the whole batch's random numbers for these rows.

        They are part `part` of the `parts` equal ones of this process's rows.
        """
        place, places = self.rank * parts + part, self.size * parts
        return nullcontext() if places == 1 else WholeBatchDraws(rng, count, place, places)

    def check(self, options: TrainingOptions) -> None:
        """Raises UserError where a batch, or with `sharding` a policy, cannot be divided."""
        _refuse_parts(options, 1)
        if options.sharding != NONE:
            raise UserError(
                f"training.sharding={options.sharding} needs several processes, found one: start them with "
                "torchrun --nproc-per-node=2 -m imfvla.train ..., or set training.sharding=none."
            )

    def mean(self, values: Tensor) -> Tensor:
        """The mean of each value over the processes, on the values' device."""
        return values

    def highest(self, values: Sequence[int]) -> list[int]:
        """The highest of each value over the processes."""
        return list(values)

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        """Gradients become their mean over the processes; sharded ones already are."""

    def begin_alike(self, policy: nn.Module) -> None:
        """The weights become those of process 0."""

    def first_of(self, values: Sequence[str], mine: str) -> str:
        """The choice of process 0 among `values`."""
        return mine

    def wait(self) -> None:
        """Waits until all processes are here."""


@dataclass(frozen=True, slots=True)
class Shared(Alone):
    """One of the processes that torchrun has started."""

    def check(self, options: TrainingOptions) -> None:
        _refuse_parts(options, self.size)
        if options.compile is True and options.sharding != NONE:
            raise UserError(
                f"training.compile must be auto or false with training.sharding={options.sharding}, found true: "
                "PyTorch compiles code again for weights that are gathered in each step."
            )

    def mean(self, values: Tensor) -> Tensor:
        total = values.clone()
        dist.all_reduce(total)
        return total / self.size

    def highest(self, values: Sequence[int]) -> list[int]:
        found = torch.tensor(values, dtype=torch.int64)
        dist.all_reduce(found, dist.ReduceOp.MAX)
        return found.tolist()

    def average_gradients(self, parameters: Iterable[nn.Parameter]) -> None:
        own = [p.grad for p in parameters if p.grad is not None and not is_part(p.grad)]
        for gradients in _buckets(own):
            flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
            dist.all_reduce(flat)
            flat /= self.size
            for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
                gradient.copy_(mean.view_as(gradient))

    def begin_alike(self, policy: nn.Module) -> None:
        for tensor in policy.state_dict().values():
            whole = tensor.contiguous()
            dist.broadcast(whole, 0)
            tensor.copy_(whole)

    def first_of(self, values: Sequence[str], mine: str) -> str:
        chosen = torch.tensor([values.index(mine)])
        dist.broadcast(chosen, 0)
        return values[int(chosen)]

    def wait(self) -> None:
        self.highest([0])


@contextmanager
def joined_processes(device: str) -> Iterator[Alone]:
    """The processes of this training, connected where torchrun has started several; `device` as in the options."""
    size = int(os.environ.get("WORLD_SIZE", "1"))
    if size == 1:
        yield Alone()
        return
    on_gpu = device != "cpu" and torch.cuda.is_available()
    if on_gpu:
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))
    local_size = int(os.environ.get("LOCAL_WORLD_SIZE", size))
    store, rank, _ = next(dist.rendezvous("env://", timeout=TIMEOUT))
    if local_size == size:
        # torchrun keeps its store over a restart, and with it the addresses of dead processes. Several machines do
        # not agree on the number of restarts; docs/reliability.md says what to do there.
        store = dist.PrefixStore(f"restart {os.environ.get('TORCHELASTIC_RESTART_COUNT', '0')}", store)
    # A group that is still referenced outlives destroy_process_group, and its threads outlive the interpreter, which
    # gloo's threads sometimes abort. At its import, which the first optimiser triggers, the functions of this module
    # take the current group as a default: imported here, before there is a group, they hold none.
    importlib.import_module("torch.distributed.nn.functional")
    # Tensors of a GPU go by nccl, which the host does not wait for, and the host's own small messages by gloo.
    backend = "cpu:gloo,cuda:nccl" if on_gpu else "gloo"
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=TIMEOUT)
    try:
        yield Shared(rank, size, local_size)
    finally:
        dist.destroy_process_group()
        forget_layouts()


def _refuse_parts(options: TrainingOptions, processes: int) -> None:
    """Raises UserError where a batch cannot be divided among processes, and there into parts."""
    parts = options.accumulate
    if options.batch_size % (processes * parts):
        among = [f"the {processes} processes"] * (processes > 1) + [f"training.accumulate={parts}"] * (
            parts > 1
        )
        raise UserError(
            f"training.batch_size must be a multiple of {' times '.join(among)}, found {options.batch_size}."
        )


def rows(batch: Batch, chosen: slice) -> Batch:
    """Some rows of a batch."""
    parts = (getattr(batch.obs, field.name)[chosen] for field in fields(Observation))
    return Batch(Observation(*parts), batch.actions[chosen], batch.valid[chosen])


class WholeBatchDraws(TorchFunctionMode):
    """Inside, random numbers of `count` rows are rows `rank` * `count` onwards of a draw for `size` times as many.

    A draw is of rows where its first dimension is a multiple of `count`: the draws of an observation lie together.
    What is drawn from `rng` is covered, and dropout, which draws from torch's own; other shapes are drawn by all
    processes alike.
    """

    def __init__(self, rng: torch.Generator, count: int, rank: int, size: int) -> None:
        super().__init__()
        self.rng, self.count, self.rank, self.size = rng, count, rank, size

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        kwargs = kwargs or {}
        if func in DRAWS and kwargs.get("generator") is self.rng:
            return self._draw(func, args, kwargs)
        if func is F.dropout:
            return self._drop(*args, **kwargs)
        return func(*args, **kwargs)

    def _draw(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Tensor:
        bounds, shape = (args[:-1], args[-1]) if func is torch.randint else ((), args)
        if len(shape) == 1 and not isinstance(shape[0], int):
            (shape,) = shape
        whole = self._whole(shape)
        if whole is None:
            return func(*args, **kwargs)
        return self._mine(func(*bounds, whole, **kwargs), shape[0])

    def _drop(self, input: Tensor, p: float = 0.5, training: bool = True, inplace: bool = False) -> Tensor:
        whole = self._whole(input.shape) if training and p > 0 else None
        if whole is None:
            return F.dropout(input, p, training, inplace)
        kept = F.dropout(torch.ones(whole, dtype=input.dtype, device=input.device), p, True)
        return input * self._mine(kept, len(input))

    def _whole(self, shape: Sequence[int]) -> tuple[int, ...] | None:
        if not shape or shape[0] == 0 or shape[0] % self.count:
            return None
        return (shape[0] * self.size, *shape[1:])

    def _mine(self, drawn: Tensor, length: int) -> Tensor:
        return drawn[self.rank * length : (self.rank + 1) * length]


def _buckets(tensors: Sequence[Tensor]) -> Iterator[list[Tensor]]:
    bucket: list[Tensor] = []
    for tensor in tensors:
        if bucket and sum(map(Tensor.numel, bucket)) + tensor.numel() > BUCKET:
            yield bucket
            bucket = []
        bucket.append(tensor)
    if bucket:
        yield bucket
