"""Whether a training runs compiled code (`nn/compiled.py`): true, false, or auto, where that saves time.

auto runs the first steps as they are written and times them. If the rest would take more than `WORTH_S`, code is
compiled from the next step on: that takes two minutes once, and saves a quarter of a step. The state keeps the
decision, so that a resumed run equals an uninterrupted one.
"""

import logging
import statistics
import time
from typing import Any

import torch
from torch import nn

from imfvla.nn.compiled import compile_loss, compile_parts, has_compiler
from imfvla.process.progress import LINE_EVERY_S
from imfvla.training.options import NONE, TrainingOptions
from imfvla.training.parallel import Alone

AUTO = "auto"
ONE_GRAPH_ON = "cuda"  # where the whole loss is compiled as one graph
EAGER, COMPILED = MODES = ("eager", "compiled")
DECIDED_AT = 20  # steps
WORTH_S = 480.0  # a quarter of it is what compiling without earlier code takes
log = logging.getLogger(__name__)


class Compiling:
    """Compiles the parts of `policy`, or on a GPU its whole loss, at once, never, or as soon as auto decides so.

    `decided` is what the state of an earlier process says for auto: one of MODES, or None.
    """

    def __init__(
        self,
        options: TrainingOptions,
        policy: nn.Module,
        device: torch.device,
        processes: Alone,
        decided: str | None = None,
    ) -> None:
        self.policy, self.processes, self.steps = policy, processes, options.steps
        if options.compile == AUTO:
            # On a GPU it was not measured; `Shared.check` says why shards are left alone.
            is_possible = device.type == "cpu" and options.sharding == NONE and has_compiler()
            self.mode = decided if is_possible else EAGER
        else:
            self.mode = COMPILED if options.compile else EAGER
        # Several processes, and parts of a batch, draw from a generator (`WholeBatchDraws`).
        self._can_be_one_graph = (
            device.type == ONE_GRAPH_ON and processes.size == 1 and options.accumulate == 1
        )
        self.is_one_graph = False  # the loss is compiled as a whole, and draws from an `OwnStream`
        self._times: list[float] = []  # of steps before the decision [s]
        self._lines: _Lines | None = None
        if self.mode == COMPILED:
            self._compile()

    def took(self, seconds: float, step: int) -> None:
        """Takes the time of step `step` (from 1); step `DECIDED_AT` decides."""
        if self.mode is not None:
            return
        self._times.append(seconds)
        if step < DECIDED_AT:
            return
        rest_s = (self.steps - step) * statistics.median(self._times)
        self.mode = self.processes.first_of(MODES, COMPILED if rest_s > WORTH_S else EAGER)
        if self.mode == COMPILED:
            log.info("the rest would take %.0f minutes: training.compile=auto compiles", rest_s / 60)
            self._compile()

    def close(self) -> None:
        """Ends the lines about compiling."""
        if self._lines is not None:
            self._lines.close()

    def _compile(self) -> None:
        compile_it = compile_loss if self._can_be_one_graph else compile_parts
        if not compile_it(self.policy):
            return
        self.is_one_graph = self._can_be_one_graph
        if self.processes.is_first:
            self._lines = _Lines()


class _Lines:
    """Lines of the log that say how far compiling is. A part is compiled when it is first called, or differentiated."""

    def __init__(self) -> None:
        from torch._dynamo.callback import callback_handler  # here, since it takes a second

        self._handler = callback_handler
        self._parts, self._spent_s = 0, 0.0
        self._began = self._last_line = time.monotonic()
        self._handler.register_start_callback(self._begin)
        self._handler.register_end_callback(self._end)

    def close(self) -> None:
        self._handler.remove_start_callback(self._begin)
        self._handler.remove_end_callback(self._end)

    def _begin(self, _: Any) -> None:
        self._began = time.monotonic()

    def _end(self, _: Any) -> None:
        now = time.monotonic()
        self._parts += 1
        self._spent_s += now - self._began
        if now - self._last_line >= LINE_EVERY_S:
            self._last_line = now
            log.info("compiling: %d parts in %.0f s", self._parts, self._spent_s)
