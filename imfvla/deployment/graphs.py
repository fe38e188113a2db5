"""The parts of a policy that become ONNX graphs, and what turns them into one.

One graph from observation and noise to chunk, with its steps written out, serves up to MAX_STEPS of them. With more the
loop stays outside: one graph prepares the observation, another is one call of the core.

Shapes: V views, H W pixels, S state, L instruction words, Tp predicted steps, A action; the batch is one observation.
"""

import contextlib
import io
import logging
import warnings
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.config.assets import install_command
from imfvla.config.construction import reason_of
from imfvla.errors import UserError
from imfvla.nn.transformer import Conditioning
from imfvla.policy import Policy
from imfvla.policy.blank import blank_observation
from imfvla.runtime.onnx_policy import CHUNK, OBSERVE, OBSERVED
from imfvla.types import Observation

MAX_STEPS = 4  # written out in one graph; a longer one takes a minute to write and is no faster
CALLS = {"flow": ("forward",), "flow and v-head": ("forward", "instant")}  # of the core, by its interface


class _Part(nn.Module):
    """A function of tensors with the weights of a policy."""

    def __init__(self, policy: Policy, function: Callable[..., Any]) -> None:
        super().__init__()
        self.policy, self.function = policy, function

    def forward(self, *tensors: Tensor) -> Any:
        return self.function(*tensors)


def policy_graphs(policy: Policy, nfe: int) -> dict[str, bytes]:
    """The ONNX models by name: "chunk" alone, or "observe" and a call of the core each. Raises UserError."""
    example = blank_observation(policy)
    inputs, noise = (example.images, example.state, example.instruction), torch.randn(1, *policy.noise_shape)
    if nfe <= MAX_STEPS:

        def chunk(images: Tensor, state: Tensor, instruction: Tensor, noise: Tensor) -> Tensor:
            return policy.predict(Observation(images, state, instruction), noise, nfe)

        return {CHUNK: to_onnx(_Part(policy, chunk), (*inputs, noise), (*OBSERVED, "noise"), (CHUNK,))}
    if policy.core.interface not in CALLS:
        raise UserError(
            f"A core of the kind {policy.core.interface!r} makes its chunk in one call: take nfe=1, found nfe={nfe}."
        )

    def observe(images: Tensor, state: Tensor, instruction: Tensor) -> tuple[Tensor, ...]:
        return policy.core.condition(policy.encoder(Observation(images, state, instruction))).tensors()

    with torch.no_grad():
        context = observe(*inputs)
    names = tuple(f"context{number}" for number in range(len(context)))
    graphs = {OBSERVE: to_onnx(_Part(policy, observe), inputs, OBSERVED, names)}
    time = torch.ones(1)
    for call in CALLS[policy.core.interface]:
        times = {"t": time, "r": 0 * time} if call == "forward" else {"t": time}
        function = _call(getattr(policy.core, call), len(times))
        graphs[call] = to_onnx(
            _Part(policy, function), (noise, *times.values(), *context), ("z", *times, *names), ("output",)
        )
    return graphs


def _call(core: Callable[..., Tensor], num_times: int) -> Callable[..., Tensor]:
    def call(z: Tensor, *rest: Tensor) -> Tensor:
        return core(z, *rest[:num_times], Conditioning.of(rest[num_times:]))

    return call


def to_onnx(
    module: nn.Module, example: tuple[Tensor, ...], inputs: Sequence[str], outputs: Sequence[str]
) -> bytes:
    """The module as an ONNX model with inputs and outputs of these names and the example's shapes. Raises UserError."""
    try:
        import onnxscript  # noqa: F401  which torch's exporter needs
    except ImportError:
        raise UserError(f"Exporting needs onnx and onnxscript: {install_command('onnx')}.") from None
    with _quietly():
        try:
            program = torch.onnx.export(
                module.eval(),
                example,
                dynamo=True,
                verbose=False,
                input_names=list(inputs),
                output_names=list(outputs),
            )
            return program.model_proto.SerializeToString()
        except Exception as error:  # a part of another package can hold anything
            raise UserError(
                f"This policy cannot be exported, but evaluated with runtime=eager; torch says {reason_of(error)!r}."
            ) from error


@contextlib.contextmanager
def _quietly() -> Any:
    """Torch's exporter reports on itself, on the terminal and in warnings of other packages."""
    disabled = logging.root.manager.disable
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(disabled)
