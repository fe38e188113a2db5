import pytest
import small_policy
import torch

from imfvla.deployment.graphs import policy_graphs
from imfvla.errors import UserError
from imfvla.policy.blank import blank_observation
from imfvla.runtime.onnx_policy import OnnxPolicy
from imfvla.types import Observation

pytest.importorskip("onnxscript")
pytest.importorskip("onnxruntime")


def observation(policy, seed):
    rng = torch.Generator().manual_seed(seed)
    shapes = blank_observation(policy)
    return Observation(
        images=torch.randint(0, 256, shapes.images.shape, generator=rng).to(torch.uint8),
        state=torch.randn(shapes.state.shape, generator=rng),
        instruction=torch.randint(0, 512, shapes.instruction.shape, generator=rng),
    )


def difference(policy, exported, nfe):
    found = []
    for seed in range(3):
        obs, noise = observation(policy, seed), torch.randn(1, *policy.noise_shape)
        with torch.inference_mode():
            found.append((policy.predict(obs, noise, nfe) - exported.predict(obs, noise, nfe)).abs().max())
    return float(max(found))


@pytest.mark.parametrize("nfe", [2, 12])
def test_graphs_compute_what_the_policy_does(nfe):
    policy = small_policy.policy().eval()
    graphs = policy_graphs(policy, nfe)
    assert graphs.keys() == ({"chunk"} if nfe == 2 else {"observe", "forward"})
    exported = OnnxPolicy(policy, nfe, graphs)
    assert difference(policy, exported, nfe) < 1e-5
    with pytest.raises(UserError, match=f"take {nfe} steps, found nfe={nfe + 1}"):
        exported.predict(observation(policy, 0), torch.zeros(1, *policy.noise_shape), nfe + 1)
