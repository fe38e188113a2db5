"""What an observation shows: which cameras, and how large their pictures may be."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from imfvla.options import build, part_of, require

SMALLEST = (8, 8)  # (H, W) [px]
LARGEST = (960, 1280)  # (H, W) [px]; the scene of our own tasks has a buffer of this size to draw into


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Cameras by name, in order, and the size (H, W) [px] of their pictures. UserError where they make no sense."""

    views: tuple[str, ...]
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        key, names = "observation.views", list(self.views)
        require(bool(names), key, "one or more views", names)
        require(len(set(names)) == len(names), key, "views that all differ", names)
        fits = all(
            low <= size <= high for low, size, high in zip(SMALLEST, self.image_size, LARGEST, strict=True)
        )
        limits = f"height {SMALLEST[0]} to {LARGEST[0]} and width {SMALLEST[1]} to {LARGEST[1]}"
        require(
            fits, "observation.image_size", f"[height, width] with {limits} pixels", list(self.image_size)
        )


def view_options(config: Mapping[str, Any]) -> ViewOptions:
    """What a policy sees, of a composed config or a run's. Raises UserError where `observation` is wrong."""
    seen = {name: part_of(config, f"observation.{name}") for name in ViewOptions.__slots__}
    return build(ViewOptions, seen, "observation")
