"""Every experiment's policy as graphs: equal to the policy, or one line that says why it has none."""

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


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_an_experiment_is_exported(experiment):
    config = compose("train", [f"+exp={experiment}", "observation.image_size=[32,32]", "core.depth=1"])
    torch.manual_seed(0)
    policy = build_unfitted(config).eval()
    nfe = max(config["evaluation"]["nfe"])
    graphs = policy_graphs(policy, nfe)
    assert (OBSERVE in graphs) == (CHUNK not in graphs) == (nfe > MAX_STEPS)
    exported = OnnxPolicy(policy, nfe, graphs)
    obs, noise = blank_observation(policy), torch.randn(1, *policy.noise_shape)
    obs.images.random_(generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        difference = (policy.predict(obs, noise, nfe) - exported.predict(obs, noise, nfe)).abs().max()
    assert difference <= TOLERANCE
