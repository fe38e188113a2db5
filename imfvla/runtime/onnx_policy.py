"""A policy that ONNX Runtime computes, with the interface of `imfvla.policy.Policy` that rollouts use.

Shapes: B batch, Tp predicted steps, A action.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from imfvla.config.assets import install_command
from imfvla.config.protocol import FRESH
from imfvla.errors import UserError
from imfvla.policy import Policy
from imfvla.types import Observation

OBSERVED = ("images", "state", "instruction")  # inputs of a graph that sees
CHUNK, OBSERVE = "chunk", "observe"  # graphs; others are calls of the core, by their names


class OnnxPolicy:
    """Predicts chunks with the graphs of `policy_graphs`. Robot, horizon and sampler are those of `policy`."""

    def __init__(self, policy: Policy, nfe: int, graphs: Mapping[str, bytes], threads: int = 1) -> None:
        self.robot, self.horizon, self.views = policy.robot, policy.horizon, policy.views
        self.image_size, self.noise_shape = policy.image_size, policy.noise_shape
        self._policy, self._nfe = policy, nfe
        self._sessions = {name: _session(graph, threads) for name, graph in graphs.items()}

    def eval(self) -> "OnnxPolicy":
        """Itself: graphs have no training mode."""
        return self

    def to(self, device: str) -> "OnnxPolicy":
        """Itself, on the CPU alone."""
        assert str(device) == "cpu"
        return self

    def check_sampling(self, nfe: int, noise_scale: float, noise: str = FRESH) -> None:
        """As `Policy.check_sampling`."""
        self._policy.check_sampling(nfe, noise_scale, noise)

    def check_replanning(self, nfe: int, candidates: int, prefix: str) -> None:
        """As `Policy.check_replanning`."""
        self._policy.check_replanning(nfe, candidates, prefix)

    def predict(self, obs: Observation, noise: Tensor, nfe: int) -> Tensor:
        """The chunk (1, Tp, A) in physical units of one observation, as `Policy.predict` computes it."""
        if nfe != self._nfe:
            raise UserError(
                f"These graphs take {self._nfe} steps, found nfe={nfe}: export them with nfe={nfe}."
            )
        observed = {name: getattr(obs, name).numpy() for name in OBSERVED}
        if CHUNK in self._sessions:
            (chunk,) = self._sessions[CHUNK].run(None, {**observed, "noise": noise.numpy()})
            return torch.from_numpy(chunk)
        context = self._sessions[OBSERVE].run(None, observed)
        chunk = self._policy.generator.sample(_Core(self._sessions), context, noise, nfe)
        return self._policy.chunks.denormalise(chunk, obs.state[:, -1])


class _Core:
    """The core as generators call it; a context is a list of arrays."""

    def __init__(self, sessions: Mapping[str, Any]) -> None:
        self._sessions = sessions

    def __call__(self, z: Tensor, t: Tensor, r: Tensor, context: list[np.ndarray]) -> Tensor:
        return self._run("forward", {"z": z, "t": t, "r": r}, context)

    def instant(self, z: Tensor, t: Tensor, context: list[np.ndarray]) -> Tensor:
        return self._run("instant", {"z": z, "t": t}, context)

    def _run(self, name: str, tensors: Mapping[str, Tensor], context: list[np.ndarray]) -> Tensor:
        session = self._sessions[name]
        given = {key: tensor.numpy() for key, tensor in tensors.items()}
        given |= {f"context{number}": array for number, array in enumerate(context)}
        used = {node.name for node in session.get_inputs()}
        (output,) = session.run(None, {key: array for key, array in given.items() if key in used})
        return torch.from_numpy(output)


def _session(graph: bytes, threads: int) -> Any:
    try:
        import onnxruntime
    except ImportError:
        raise UserError(f"ONNX Runtime is missing: {install_command('onnx')}.") from None
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 3  # errors: it warns about initializers that the exporter left
    return onnxruntime.InferenceSession(graph, options, providers=["CPUExecutionProvider"])
