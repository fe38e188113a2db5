"""Every residual goes with every way of conditioning, at any depth and width."""

import pytest
import torch

from imfvla.command.composition import compose
from imfvla.config.construction import construct
from imfvla.errors import UserError
from imfvla.policy import build_policy

CONDITIONING = {"token": "TransformerCore", "cross": "CrossAttentionCore", "adaln": "AdaptiveNormCore"}
RESIDUALS = {
    "standard": "StandardResidual",
    "attnres": "AttentionResidual",
    "block_attnres": "BlockAttentionResidual",
}
SIZES = {"default": [], "emb384-layer18": ["core.width=384", "core.depth=18", "core.heads=6"]}


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("conditioning", CONDITIONING)
@pytest.mark.parametrize("residual", RESIDUALS)
def test_core_composes_and_builds(residual, conditioning, size):
    config = compose("train", [f"core={residual}", f"core/conditioning={conditioning}", *SIZES[size]])
    with torch.device("meta"):
        core = construct(config["core"], "core", channels=5)
    assert type(core).__name__ == CONDITIONING[conditioning]
    assert type(core.residual).__name__ == RESIDUALS[residual]
    assert (core.width, len(core.blocks)) == (config["core"]["width"], config["core"]["depth"])
    context = core.condition(torch.empty(2, 5, core.width, device="meta"))
    times = torch.empty(2, device="meta")
    x = torch.empty(2, core.steps, core.channels, device="meta")
    assert core(x, times, times, context).shape == x.shape


def test_the_deep_row_has_width_384_and_18_layers_at_the_paper_s_scale():
    config = compose("train", ["+exp=transfer_ddpm_emb384_layer18", "scale=paper"])
    with torch.device("meta"):
        core = construct(config["core"], "core", channels=5)
    assert (core.width, len(core.blocks)) == (384, 18)


def test_a_block_beyond_the_core_is_refused_in_one_sentence():
    config = compose("train", ["core=block_attnres", "core.residual.block_size=9"])
    with pytest.raises(
        UserError,
        match=r"^core\.residual\.block_size must .* 1 to the 8 sublayers .* found 9: .*core\.depth\.$",
    ):
        build_policy(config)
