"""Every trunk gives one token of each view or several; one name stands for full AttnRes vision at both scales."""

import pytest
import torch

from imfvla.command.composition import compose
from imfvla.config.construction import construct

TRUNKS = {
    "compact": "CompactCNN",
    "compact_resnet": "CompactResNet",
    "compact_attnres": "CompactResNet",
    "resnet18": "ResNet18",
    "resnet18_attnres": "ResNet18",
}


@pytest.mark.parametrize("tokens", [1, 4])
@pytest.mark.parametrize("encoder", TRUNKS)
def test_encoder_composes_and_builds(encoder, tokens):
    config = compose("train", [f"encoder={encoder}", f"encoder.view_tokens.tokens={tokens}"])
    with torch.device("meta"):
        made = construct(config["encoder"], "encoder", views=3, state_dim=5)
    assert type(made.vision).__name__ == TRUNKS[encoder]
    assert made.view_tokens.tokens == tokens
    assert made.summary.in_features == (3 * tokens + 2) * config["core"]["width"]


@pytest.mark.parametrize(("scale", "trunk"), [("cpu", "CompactResNet"), ("paper", "ResNet18")])
def test_full_attnres_vision_is_found_by_the_scale_s_name(scale, trunk):
    vision = compose("train", [f"scale={scale}", f"encoder=attnres/{scale}"])["encoder"]["vision"]
    assert vision["_target_"].endswith(trunk)
    assert vision["residual"] == "attention"
