"""Samples of a policy at recorded observations, several from each.

Shapes: N observations, K samples of each, Tp predicted steps, A action.
"""

import numpy as np
import torch

from imfvla.modes.observations import Observations
from imfvla.policy import Policy
from imfvla.policy.noise import chunk_noise
from imfvla.types import Observation

ROWS = 256  # chunks that are computed together


@torch.inference_mode()
def draw_samples(policy: Policy, observations: Observations, nfe: int, num: int) -> np.ndarray:
    """float32 (N, num, Tp, A) in physical units.

    The noise of sample k at step s of the demonstration from `seed` is drawn from SeedSequence([k, seed, s]) alone, so
    that all policies with equal chunks, and all NFE, see the same.
    """
    device = next(policy.parameters()).device
    each = max(ROWS // num, 1)
    chunks = []
    for begin in range(0, len(observations), each):
        rows = slice(begin, begin + each)
        images, state, instruction = (
            torch.from_numpy(np.stack(values[rows])).to(device)
            for values in (observations.images, observations.state, observations.instruction)
        )
        places = [(k, *place) for place in observations.places[rows] for k in range(num)]
        noise = chunk_noise(policy.noise_shape, places)
        seen = Observation(images.permute(0, 1, 2, 5, 3, 4), state, instruction)
        chunk = policy.predict(seen, noise.to(device), nfe)
        chunks.append(chunk.float().cpu().numpy().reshape(-1, num, *policy.noise_shape))
    return np.concatenate(chunks)
