"""In which steps of a training a parameter learns, for methods whose training has stages."""

import math
from collections.abc import Mapping

Span = tuple[float, float]  # the steps [first, end)
Spans = Mapping[str, Span]  # by the names of parameters; others learn in all steps
WHOLE: Span = (0, math.inf)
