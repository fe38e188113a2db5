"""The gradient of a batch, computed in parts one after the other: the same numbers with the memory of a part.

Losses are means over rows, so that the mean of equal parts is that of the whole. Each part draws the random numbers
that its rows would have in the whole batch (`parallel.WholeBatchDraws`).
"""

import torch
from torch import Tensor, nn

from imfvla.draws import OwnStream
from imfvla.training.parallel import Alone, rows
from imfvla.training.precision import autocast
from imfvla.types import Batch


def add_gradients(
    policy: nn.Module,
    share: Batch,
    parts: int,
    *,
    seed: int,
    precision: str,
    processes: Alone,
    own_stream: bool = False,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Adds the gradient of the mean loss over `share`, this process's rows, to those of the policy's parameters.

    Every random number is drawn on the rows' device from `seed`, with `own_stream` from torch's own numbers.

    Returns:
      The loss, a scalar, and what to log, means over the parts, all without gradient.
    """
    device, count = share.actions.device, len(share.actions) // parts
    losses, logs = [], []
    for part in range(parts):
        torch.manual_seed(seed)  # for what takes no generator
        rng = OwnStream(device) if own_stream else torch.Generator(device).manual_seed(seed)
        some = share if parts == 1 else rows(share, slice(part * count, (part + 1) * count))
        with autocast(precision, device), processes.draws(rng, count, part, parts):
            loss, said = policy.loss(some, rng)
        (loss if parts == 1 else loss / parts).backward()
        losses.append(loss.detach())
        logs.append(said)
    if parts == 1:
        return losses[0], logs[0]
    mean = {name: torch.stack([said[name] for said in logs]).mean(0) for name in logs[0]}
    return torch.stack(losses).mean(0), mean
