"""LeRobot's ACT, measured on request. `tools/peers.py` runs this with the Python of LeRobot's environment.

The argument is JSON with the sizes. The first line that is printed says what was built; each line that is read, "train"
or "predict", is answered by a line with the processor time of one call [ms].
"""

import json
import sys
import time
from importlib.metadata import version

import torch
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.policies.act.configuration_act import ACTConfig
from lerobot.policies.act.modeling_act import ACTPolicy

sizes = json.loads(sys.argv[1])
answers, sys.stdout = sys.stdout, sys.stderr  # what LeRobot prints is no answer
torch.set_num_threads(sizes["threads"])
torch.manual_seed(0)
images = [f"observation.images.{number}" for number in range(sizes["views"])]
inputs = {name: PolicyFeature(FeatureType.VISUAL, (3, *sizes["image_size"])) for name in images}
inputs["observation.state"] = PolicyFeature(FeatureType.STATE, (sizes["state"],))
policy = ACTPolicy(
    ACTConfig(
        input_features=inputs,
        output_features={"action": PolicyFeature(FeatureType.ACTION, (sizes["action"],))},
        chunk_size=sizes["steps"],
        n_action_steps=sizes["steps"],
        pretrained_backbone_weights=None,
        dim_model=sizes["width"],
        n_heads=sizes["heads"],
        dim_feedforward=sizes["hidden"],
        n_encoder_layers=sizes["encoder_layers"],
        n_decoder_layers=sizes["decoder_layers"],
        n_vae_encoder_layers=sizes["style_layers"],
        latent_dim=sizes["style_width"],
        device="cpu",
    )
)
optimiser = torch.optim.AdamW(policy.parameters(), lr=1e-5, fused=True)


def batch(rows: int) -> dict[str, torch.Tensor]:
    made = {name: torch.rand(rows, 3, *sizes["image_size"]) for name in images}
    made["observation.state"] = torch.randn(rows, sizes["state"])
    made["action"] = torch.randn(rows, sizes["steps"], sizes["action"])
    made["action_is_pad"] = torch.zeros(rows, sizes["steps"], dtype=torch.bool)
    return made


def train() -> None:
    policy.train()
    loss, _ = policy(training)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(policy.parameters(), 10.0)
    optimiser.step()
    optimiser.zero_grad(set_to_none=True)


training, observed = batch(sizes["batch"]), batch(1)
calls = {"train": train, "predict": lambda: policy.predict_action_chunk(observed)}
parameters = sum(parameter.numel() for parameter in policy.parameters())
print(json.dumps({"version": version("lerobot"), "parameters": parameters}), file=answers, flush=True)
for line in sys.stdin:
    began = time.process_time()
    calls[line.strip()]()
    print(json.dumps(1e3 * (time.process_time() - began)), file=answers, flush=True)
