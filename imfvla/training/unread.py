"""What steps measure, on the policy's device until a row of the log is due: nothing waits for a GPU in between."""

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor


class Unread:
    """Scalars of the steps since the last reading, which are read together."""

    def __init__(self) -> None:
        self._steps: list[tuple[int, tuple[str, ...]]] = []
        self._values: list[Tensor] = []

    def add(self, step: int, scalars: Mapping[str, Tensor | float]) -> None:
        """Takes the scalars of step `step`, tensors of one device among them."""
        device = next(value.device for value in scalars.values() if isinstance(value, Tensor))
        self._steps.append((step, tuple(scalars)))
        self._values.append(
            torch.stack(
                [
                    value.detach().to(torch.float64)
                    if isinstance(value, Tensor)
                    else torch.full((), value, dtype=torch.float64, device=device)  # no copy from the host
                    for value in scalars.values()
                ]
            )
        )

    def read(self) -> Iterator[tuple[int, dict[str, float]]]:
        """The steps in their order, each with its scalars; they count as read from now on."""
        steps, values = self._steps, self._values
        self._steps, self._values = [], []
        numbers = iter(torch.cat(values).tolist() if values else ())
        for step, names in steps:
            yield step, {name: next(numbers) for name in names}
