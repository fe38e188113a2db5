"""An observation that shows nothing, to try a policy with."""

import torch

from imfvla.policy import Policy
from imfvla.types import MAX_WORDS, Observation


def blank_observation(policy: Policy) -> Observation:
    """Black pictures, zeros as the state and an empty sentence, of batch 1."""
    steps = policy.horizon.obs
    return Observation(
        images=torch.zeros(1, steps, len(policy.views), 3, *policy.image_size, dtype=torch.uint8),
        state=torch.zeros(1, steps, len(policy.robot.state)),
        instruction=torch.zeros(1, MAX_WORDS, dtype=torch.int64),
    )
