"""What a policy is asked at a decision, and its answers to the decisions of one episode or of several at once.

Shapes: To observed steps, V views, H W pixels, S state, L words, N candidates, Tp predicted steps, A action.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from imfvla.data.resample import resample
from imfvla.policy import Policy
from imfvla.policy.prefix import Known
from imfvla.types import Observation


@dataclass(frozen=True, slots=True)
class Question:
    """What a chunk of one episode is a function of."""

    observation: Observation  # of batch 1
    noise: Tensor  # (N, Tp, A)
    known: Known | None  # actions that are decided already
    took_ms: float  # from numpy arrays to this


def answers(
    policy: Policy,
    questions: Sequence[Question | None],
    nfe: int,
    device: torch.device,
    *,
    derives: bool = False,
) -> tuple[list[np.ndarray | None], float]:
    """The samples float32 (N, Tp, A) for each question, None for None, from one call of `policy`.

    An empty place is computed as a copy of another one: the shapes of a call, and with them the rounding of a place, do
    not depend on who else asks. Only a question that is alone may have `known`. `derives` says that the sampler takes
    derivatives, which inference mode does not allow.

    Returns:
      The samples, and the time from numpy observations to them [ms], which every one of these chunks takes.
    """
    began = time.perf_counter()
    asked = [question for question in questions if question is not None]
    rows = [question or asked[0] for question in questions]
    seen = [question.observation for question in rows]
    observation = Observation(
        images=_joined([one.images for one in seen]),
        state=_joined([one.state for one in seen]),
        instruction=_joined([one.instruction for one in seen]),
    ).to(device)
    noise = _joined([question.noise for question in rows]).to(device)
    told = {} if asked[0].known is None else {"known": asked[0].known}
    assert not told or len(rows) == 1
    with torch.no_grad() if derives else torch.inference_mode():
        chunks = policy.predict(observation, noise, nfe, **told)
        found = chunks.float().cpu().numpy()  # waits for an accelerator
    samples = found.reshape(len(rows), -1, *found.shape[1:])
    took_ms = sum(question.took_ms for question in asked) + 1e3 * (time.perf_counter() - began)
    return [None if asks is None else own for asks, own in zip(questions, samples, strict=True)], took_ms


def _joined(tensors: Sequence[Tensor]) -> Tensor:
    return tensors[0] if len(tensors) == 1 else torch.cat(list(tensors))


def observation_of(
    images: Sequence[Sequence[np.ndarray]],
    states: Sequence[np.ndarray],
    words: np.ndarray,
    size: tuple[int, int],
) -> Observation:
    """What a policy sees, of batch 1, from the V pictures and the state of each of To steps and word ids int64 (L,).

    Pictures are uint8 (H, W, 3) of any size, and are brought to `size` (H, W).
    """
    fitted = np.stack([[resample(picture, size) for picture in step] for step in images])
    return Observation(
        images=torch.from_numpy(fitted).permute(0, 1, 4, 2, 3).unsqueeze(0),
        state=torch.from_numpy(np.stack(states)).unsqueeze(0),
        instruction=torch.from_numpy(words).unsqueeze(0),
    )
