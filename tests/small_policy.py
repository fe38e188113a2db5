"""A policy of some thousand parameters, a batch for it and its loss."""

from types import SimpleNamespace

import numpy as np
import torch

from imfvla.policy import build_policy
from imfvla.types import Batch, Observation, tokenize

STATISTICS = SimpleNamespace(
    state_min=np.full(16, -2.0, np.float32),
    state_max=np.full(16, 2.0, np.float32),
    action_mean=np.full(16, -1.0, np.float32),
    action_std=np.full(16, 2.0, np.float32),
    displacement_mean=np.full((8, 16), 0.5, np.float32),
    displacement_std=np.full((8, 16), 0.1, np.float32),
)


def config(**changes):
    return {
        "horizon": {"obs": 1, "pred": 8, "exec": 4},
        "task": {"name": "socket"},
        "observation": {"views": ["front", "top"], "image_size": [32, 32]},
        "action_frame": "absolute",
        "encoder": {
            "_target_": "imfvla.encoders.observation.ObservationEncoder",
            "vision": {
                "_target_": "imfvla.encoders.vision.CompactCNN",
                "hidden": (8, 8),
                "channels": 4,
            },
            "observed_steps": 1,
            "width": 16,
            "image_size": (32, 32),
            "view_tokens": {"_target_": "imfvla.encoders.tokens.GridTokens", "_partial_": True, "tokens": 1},
        },
        "core": {
            "_target_": "imfvla.nn.transformer.TransformerCore",
            "steps": 8,
            "width": 16,
            "depth": 2,
            "heads": 2,
            "patch": 4,
            "mlp_ratio": 2.0,
            "max_rad": 10.0,
            "residual": {
                "_target_": "imfvla.nn.residual.AttentionResidual",
                "_partial_": True,
                "readout": "sum",
            },
        },
        "generator": {
            "_target_": "imfvla.generators.imf.ImprovedMeanFlow",
            "parametrisation": "data",
            "times": {"_target_": "imfvla.generators.base.UniformTimes"},
            "boundary_share": 0.1,
            "v_from": "boundary",
            "instant_weight": 1.0,
            "compound_target": "sample",
            "time_power": 2.0,
            "adaptive_power": 0.5,
            "adaptive_offset": 1e-3,
            "draws": 2,
            "compound_draws": 1,
            "clip": 1.0,
        },
    } | changes


def policy(statistics=STATISTICS, **changes):
    torch.manual_seed(0)
    made = build_policy(config(**changes), statistics)
    torch.nn.init.normal_(made.core.output.weight, std=0.1)
    return made


def batch(rows=3):
    rng = torch.Generator().manual_seed(0)
    obs = Observation(
        torch.randint(0, 256, (rows, 1, 2, 3, 32, 32), generator=rng, dtype=torch.uint8),
        torch.rand(rows, 1, 16, generator=rng),
        torch.from_numpy(tokenize("put the peg in")).expand(rows, -1),
    )
    valid = torch.ones(rows, 8, dtype=torch.bool)
    valid[-1, 5:] = False
    return Batch(obs, 4 * torch.rand(rows, 8, 16, generator=rng) - 3, valid)


def loss(made, data):
    return made.loss(data, torch.Generator().manual_seed(1))[0]
