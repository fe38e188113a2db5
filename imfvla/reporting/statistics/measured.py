"""A number with its interval."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Measured:
    """A number and its 95% interval; None where there is no such number, or where too few give it for an interval."""

    value: float | None
    low: float | None = None
    high: float | None = None

    def scaled(self, factor: float) -> "Measured":
        numbers = (self.value, self.low, self.high)
        return Measured(*(None if number is None else factor * number for number in numbers))
