"""How times are taken: after a warm-up, many times, as median and 95th percentile."""

import time
from collections.abc import Callable, Sequence

import numpy as np


def times_ms(functions: Sequence[Callable[[], object]], calls: int, warm_up: int = 3) -> np.ndarray:
    """Wall times of calling the functions in turn [ms], float64 (functions, calls), after `warm_up` turns."""
    taken = np.empty((len(functions), warm_up + calls))
    for turn in range(warm_up + calls):
        for index, function in enumerate(functions):
            began = time.perf_counter()
            function()
            taken[index, turn] = time.perf_counter() - began
    return 1e3 * taken[:, warm_up:]


def rate(function: Callable[[], object], seconds: float) -> float:
    """Calls per second, measured over at least `seconds`, after one call that does not count."""
    function()
    began, calls = time.perf_counter(), 0
    while (elapsed := time.perf_counter() - began) < seconds:
        function()
        calls += 1
    return calls / elapsed
