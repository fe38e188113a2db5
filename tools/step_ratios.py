"""Processor time of training steps: compiled over eager, and Attention Residuals over fixed ones.

python tools/step_ratios.py
python tools/step_ratios.py --only "imf, first stage" --compile --cold

Steps are taken in turn, in one process with one thread, on a made-up batch of the experiment's size in the precision
that `training.precision=auto` takes here; the ratio is of the fastest ones. Compiling is timed where it happens: in
this process (tracing, one core) and in its children (the C++ compiler, all cores). `--cold` compiles everything again,
in a directory of its own.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import os
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn

from imfvla.command.composition import compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.nn.compiled import CACHE, compile_parts
from imfvla.policy import Policy
from imfvla.policy.blank import blank_observation
from imfvla.reporting.table import Table, number
from imfvla.training.experiment import read_experiment
from imfvla.training.optimiser import make_optimiser
from imfvla.training.precision import autocast, choose_precision
from imfvla.types import Batch, Observation

DEVICE = torch.device("cpu")
CASES = {  # overrides, and the share of a training at which the step is
    "imf, first stage": ([], 0.0),
    "imf, second stage": ([], 0.99),
    "imf_plain": (["generator=imf_plain"], 0.0),
    "flow_high_noise": (["generator=flow_high_noise"], 0.0),
}
FIXED = "core=standard"


@dataclass(frozen=True, slots=True)
class Spent:
    """Processor time [s] of this process and of those that it has waited for."""

    own: float
    children: float

    @classmethod
    def now(cls) -> "Spent":
        return cls(*(_seconds(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))

    def since(self, earlier: "Spent") -> "Spent":
        return Spent(self.own - earlier.own, self.children - earlier.children)


def _seconds(who: int) -> float:
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


def random_batch(policy: Policy, rows: int) -> Batch:
    """Noise in the shapes of a batch, every step valid."""
    rng, blank = torch.Generator().manual_seed(1), blank_observation(policy)
    images = torch.randint(0, 256, (rows, *blank.images.shape[1:]), dtype=torch.uint8, generator=rng)
    state = torch.rand(rows, *blank.state.shape[1:], generator=rng)
    obs = Observation(images, state, blank.instruction.expand(rows, -1).clone())
    actions = torch.rand(rows, *policy.noise_shape, generator=rng)
    return Batch(obs, actions, torch.ones(actions.shape[:2], dtype=torch.bool))


def stepper(overrides: list[str], share: float, precision: str, compiled: bool) -> Callable[[], object]:
    """A training step of the experiment that the overrides compose, at this share of its steps."""
    config = compose("train", overrides)
    options = read_experiment(config)
    torch.manual_seed(0)
    policy, steps = build_unfitted(config).train(), options.training.steps
    step, spans = int(share * steps), policy.spans(steps)
    for name, parameter in policy.named_parameters():
        parameter.requires_grad_(step < spans.get(name, (0, steps))[1])
    if compiled:
        compile_parts(policy)
    batch = random_batch(policy, options.training.batch_size)
    optimiser = make_optimiser(policy, options.optim, spans)
    policy.begin_step(step, steps)

    def go() -> None:
        optimiser.zero_grad(set_to_none=True)
        with autocast(precision, DEVICE):
            loss, _ = policy.loss(batch, torch.Generator().manual_seed(0))
        loss.backward()
        nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimiser.step()

    return go


def fastest_ms(functions: list[Callable[[], object]], rounds: int) -> list[float]:
    """Shortest processor time of each [ms], called in turn."""
    taken: list[list[float]] = [[] for _ in functions]
    for _ in range(rounds):
        for function, times in zip(functions, taken, strict=True):
            began = time.process_time()
            function()
            times.append(1e3 * (time.process_time() - began))
    return [min(times) for times in taken]


def measure(name: str, options: argparse.Namespace, precision: str) -> list[tuple[str, ...]]:
    """Rows of the table for one case: what a step takes, its ratio, what compiling took."""
    extra, share = CASES[name]
    attnres = [f"+exp={options.experiment}", *extra]
    kinds = [("eager", attnres, False)]
    if options.compile:
        kinds.append(("compiled", attnres, True))
    if options.fixed:
        kinds += [(f"{kind}, fixed residuals", [*attnres, FIXED], compiled) for kind, _, compiled in kinds]
    functions, compiling = [], []
    for kind, overrides, compiled in kinds:
        function, began = stepper(overrides, share, precision, compiled), Spent.now()
        function()
        spent = Spent.now().since(began)
        compiling.append(f"{spent.own:.0f} + {spent.children:.0f}" if compiled else "")
        functions.append(function)
        print(f"{name}, {kind}: first step after {spent.own:.0f} + {spent.children:.0f} s", file=sys.stderr)
    times = fastest_ms(functions, options.rounds)
    return [
        (name, kind, number(taken, 0), number(taken / times[0], 2), spent)
        for (kind, *_), taken, spent in zip(kinds, times, compiling, strict=True)
    ]


@as_command
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--experiment", default="transfer_ph32_exec16")
    parser.add_argument("--only", choices=CASES, action="append", help="of the cases; all where not said")
    parser.add_argument("--compile", action=argparse.BooleanOptionalAction, default=True)
    parser.add_argument(
        "--fixed", action=argparse.BooleanOptionalAction, default=True, help="fixed residuals too"
    )
    parser.add_argument("--cold", action="store_true", help="take no code from earlier runs")
    parser.add_argument("--rounds", type=int, default=12)
    options = parser.parse_args(arguments)
    torch.set_num_threads(1)
    precision = choose_precision("auto", DEVICE)
    rows = []
    with tempfile.TemporaryDirectory(prefix="imfvla-inductor-") as scratch:
        if options.cold:
            os.environ[CACHE] = scratch
        for name in options.only or CASES:
            rows += measure(name, options, precision)
    columns = ("Case", "Step", "ms", "Ratio to eager", "Compiling [s], own + children")
    Table(f"{options.experiment}, {precision}, one thread", columns, tuple(rows)).print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
