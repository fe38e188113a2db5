"""The learning rate as a pure function of the step, so that resuming needs no state."""

import math


def learning_rate(step: int, *, steps: int, peak: float, warmup: float, floor: float) -> float:
    """Rate of the update that takes `step` (0-based) to `step + 1`.

    Rises linearly to `peak` over the first `warmup * steps` updates, then falls along half a cosine to
    `floor * peak` at the last one.
    """
    rising = round(warmup * steps)
    if step < rising:
        return peak * (step + 1) / rising
    progress = (step - rising) / max(1, steps - 1 - rising)
    return peak * (floor + (1 - floor) * 0.5 * (1 + math.cos(math.pi * min(1.0, progress))))
