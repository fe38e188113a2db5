"""Every experiment's policy as graphs: equal to the policy, or one line that says why it has none."""

import json

import pytest
import torch

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.deployment.graphs import MAX_STEPS, policy_graphs
from imfvla.deployment.parity import TOLERANCE
from imfvla.policy.blank import blank_observation
from imfvla.runtime.onnx_policy import CHUNK, OBSERVE, OnnxPolicy

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")
EXPERIMENTS = sorted(path.stem for path in (CONFIG_DIRECTORY / "exp").glob("*.yaml"))
SMALL = ["observation.image_size=[32,32]", "core.depth=1", "horizon.pred=40", "horizon.exec=1"]
PARTS = (
    "encoder",
    "core",
    "generator",
    "observation",
    "action_frame",
)  # of a config, that a graph depends on
exported: dict[str, float] = {}  # small experiments that differ in nothing else are exported once


def difference(config, nfe):
    torch.manual_seed(0)
    policy = build_unfitted(config).eval()
    graphs = policy_graphs(policy, nfe)
    assert (OBSERVE in graphs) == (CHUNK not in graphs) == (nfe > MAX_STEPS)
    obs, noise = blank_observation(policy), torch.randn(1, *policy.noise_shape)
    obs.images.random_(generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        chunks = (one.predict(obs, noise, nfe) for one in (policy, OnnxPolicy(policy, nfe, graphs)))
        return float(torch.sub(*chunks).abs().max())


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_is_exported(experiment):
    config = compose("train", [f"+exp={experiment}", *SMALL])
    task = config["task"]["name"] if "robot" in config["task"] else "bimanual"
    for nfe in {min(config["evaluation"]["nfe"]), max(config["evaluation"]["nfe"])} - {2, 3}:
        key = json.dumps([task, nfe, *(config[part] for part in PARTS)], default=str)
        if key not in exported:
            exported[key] = difference(config, nfe)
        assert exported[key] <= TOLERANCE
