"""The protocol of an evaluation: what its rows depend on, beside the code. Needs neither torch nor mujoco."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

USUAL_NOISE = 1.0


@dataclass(frozen=True, slots=True)
class Protocol:
    """Equal protocols give equal rows but for times."""

    task: str
    variant: str
    checkpoint_step: int
    weights: str  # first 16 hex digits of the SHA-256 of the weights
    nfe: int
    noise_seed: int
    noise_scale: float  # of the noise that a chunk starts from; 1 is what policies are trained with
    first_seed: int
    episodes: int
    max_steps: int | None  # control steps of an episode, None for all of them
    device: str  # "cpu" or "cuda", where the policy computes

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)

    def name(self, last_step: int) -> str:
        """The folder in `rollouts/`: seeds and nfe, and what is unusual where the weights of `last_step` are usual."""
        unusual = {
            f"_step{self.checkpoint_step}": self.checkpoint_step != last_step,
            f"_noise{self.noise_seed}": self.noise_seed != 0,
            f"_scale{self.noise_scale:g}": self.noise_scale != USUAL_NOISE,
            f"_max{self.max_steps}": self.max_steps is not None,
            f"_{self.device}": self.device != "cpu",
        }
        suffixes = "".join(text for text, applies in unusual.items() if applies)
        return f"seeds{self.seeds[0]}-{self.seeds[-1]}_nfe{self.nfe}{suffixes}"


def as_recorded(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """The "protocol" of a summary, which may have been written before `noise_scale` was known."""
    return {"noise_scale": USUAL_NOISE, **protocol}
