"""Our ACT beside LeRobot's, of the same sizes, on the same machine and in turn: processor time of a step and a chunk.

python tools/peers.py                            # LeRobot from .venvs/lerobot
python tools/peers.py --python PATH scale=paper      # overrides of our +exp=socket_act

Both have a ResNet-18, of whose features LeRobot makes a token each and ours four a picture. Ours is measured eager, as
LeRobot runs, and as it is used here: compiled in long trainings, and exported to ONNX Runtime for chunks (--eager: not
so). Where LeRobot is missing, the reason is printed and nothing is measured. diffusion_policy has no release to install
and is not measured.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from imfvla.command.composition import compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.deployment.graphs import policy_graphs
from imfvla.errors import UserError
from imfvla.nn.compiled import compile_parts, has_compiler
from imfvla.policy import Policy
from imfvla.policy.blank import blank_observation
from imfvla.reporting.table import Table, number
from imfvla.runtime.graphs import missing_packages
from imfvla.runtime.onnx_policy import OnnxPolicy
from imfvla.training.experiment import read_experiment
from imfvla.training.optimiser import make_optimiser
from imfvla.types import Batch, Observation

USUAL = Path(".venvs/lerobot/bin/python")
RIVAL = Path(__file__).with_name("rivals") / "lerobot_act.py"
THEIRS = {"train": "train", "compiled": "train", "predict": "predict", "onnx": "predict"}  # of our calls
OURS = ("+exp=socket_act", "encoder=resnet18")  # LeRobot's encoder is a ResNet-18 as well
NOT_RELEASED = "diffusion_policy is not measured: no package index has a release of it."
FILL = "python3.12 -m venv .venvs/lerobot && .venvs/lerobot/bin/pip install lerobot"


def sizes_of(config: Mapping[str, Any], policy: Policy, batch: int, threads: int) -> dict[str, Any]:
    """What LeRobot's ACT is built with to be as large as ours."""
    core = config["core"]
    return {
        "views": len(policy.views),
        "image_size": list(policy.image_size),
        "state": len(policy.robot.state),
        "action": len(policy.robot.action),
        "steps": policy.horizon.pred,
        "width": core["width"],
        "heads": core["heads"],
        "hidden": int(core["mlp_ratio"] * core["width"]),
        "encoder_layers": core["depth"],
        "decoder_layers": core["decoder_depth"],
        "style_layers": core["style_depth"],
        "style_width": core["style_width"],
        "batch": batch,
        "threads": threads,
    }


def our_calls(
    config: Mapping[str, Any], policy: Policy, batch: int, is_eager: bool
) -> dict[str, Callable[[], object]]:
    """Training steps and chunks of ours, on random numbers.

    Unless `is_eager`, compiled and exported ones too, where there are a C++ compiler and ONNX Runtime.
    """
    blank, noise = blank_observation(policy), torch.zeros(1, *policy.noise_shape)
    seen = Observation(
        *(
            tensor.expand(batch, *tensor.shape[1:])
            for tensor in (blank.images, blank.state, blank.instruction)
        )
    )
    actions = torch.randn(batch, *policy.noise_shape)
    training = Batch(seen, actions, torch.ones(batch, policy.horizon.pred, dtype=torch.bool))
    rng = torch.Generator().manual_seed(0)

    def training_step(policy: Policy) -> Callable[[], None]:
        optimiser = make_optimiser(policy, read_experiment(config).optim)

        def train() -> None:
            policy.train()
            policy.loss(training, rng)[0].backward()
            torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
            optimiser.step()
            optimiser.zero_grad(set_to_none=True)

        return train

    @torch.inference_mode()
    def predict(policy: Policy | OnnxPolicy) -> None:
        policy.eval().predict(blank, noise, 1)

    calls = {"train": training_step(policy), "predict": partial(predict, policy)}
    if not is_eager and has_compiler():
        compiled = build_unfitted(config)
        compile_parts(compiled)
        calls["compiled"] = training_step(compiled)
    if not is_eager and not missing_packages():
        calls["onnx"] = partial(predict, OnnxPolicy(policy, 1, policy_graphs(policy, 1)))
    return calls


class Rival:
    """LeRobot's ACT in a process of its own. Raises UserError where it is not installed."""

    def __init__(self, python: Path, sizes: Mapping[str, Any]) -> None:
        if not python.exists():
            raise UserError(f"LeRobot is not measured: {python} is missing. Make it: {FILL}")
        command = [str(python), str(RIVAL), json.dumps(sizes)]
        self._process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, encoding="utf-8"
        )
        self.built = self._answer()

    def time_ms(self, call: str) -> float:
        self._process.stdin.write(f"{call}\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> Any:
        line = self._process.stdout.readline()
        if not line:
            _, said = self._process.communicate()
            last = (said.strip().splitlines() or ["nothing"])[-1]
            raise UserError(f"LeRobot is not measured: its process ended and said {last!r}. Make it: {FILL}")
        return json.loads(line)

    def close(self) -> None:
        self._process.communicate()


def measure(ours: Mapping[str, Callable[[], object]], rival: Rival, rounds: int) -> dict[str, np.ndarray]:
    """Processor time [ms] of each call by (ours, theirs), float64 (2, rounds), in turn and after one that warms up."""
    found = {call: np.empty((2, rounds + 1)) for call in THEIRS if call in ours}
    for turn in range(rounds + 1):
        for call in found:
            began = time.process_time()
            ours[call]()
            found[call][:, turn] = 1e3 * (time.process_time() - began), rival.time_ms(THEIRS[call])
    return {call: times[:, 1:] for call, times in found.items()}


@as_command
def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--python", type=Path, default=USUAL, help="of an environment with LeRobot")
    parser.add_argument("--batch", type=int, default=8, help="rows of a training step")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--eager", action="store_true", help="neither compile nor export ours")
    parser.add_argument("overrides", nargs="*", help="of +exp=socket_act, such as scale=paper")
    options = parser.parse_args(arguments)
    torch.set_num_threads(options.threads)
    print(NOT_RELEASED)
    config = compose("train", [*OURS, *options.overrides])
    policy = build_unfitted(config)
    try:
        rival = Rival(options.python, sizes_of(config, policy, options.batch, options.threads))
    except UserError as reason:
        print(reason)
        return 0
    calls = our_calls(config, policy, options.batch, options.eager)
    times = measure(calls, rival, options.rounds)
    rival.close()
    millions = [sum(p.numel() for p in policy.parameters()) / 1e6, rival.built["parameters"] / 1e6]
    rows = [
        ("parameters [M]", *(number(count, 1) for count in millions), number(millions[1] / millions[0], 2))
    ]
    names = {
        "train": f"training step, batch {options.batch} [ms]", "compiled": "the same, ours compiled [ms]",
        "predict": "chunk [ms]", "onnx": "the same, ours by ONNX Runtime [ms]",
    }  # fmt: skip
    for call, of_call in times.items():
        ours, theirs = np.median(of_call, axis=1)
        rows.append((names[call], number(ours, 1), number(theirs, 1), number(theirs / ours, 2)))
    note = f"Processor time, medians of {options.rounds} calls in turn, {options.threads} thread(s) each."
    title = f"ACT here and in LeRobot {rival.built['version']}"
    Table(title, ("", "Ours", "LeRobot", "LeRobot / ours"), tuple(rows), (note,)).print()
    return 0


if __name__ == "__main__":
    sys.exit(main())
