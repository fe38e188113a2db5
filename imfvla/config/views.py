"""What an observation shows: which cameras, and how large their pictures may be."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from imfvla.options import build, part_of, require

VIEWS, SIZE = "observation.views", "observation.image_size"
SMALLEST = 8  # pixels of a side
MAX_PIXELS = 4096 * 4096  # of one picture: a small file can state a size that fills the memory


@dataclass(frozen=True, slots=True)
class ViewOptions:
    """Cameras by name, in order, and the size (H, W) [px] of their pictures. UserError where they make no sense.

    views: None for all that the robot has, which `imfvla.robot_of.with_robot` names.
    """

    views: tuple[str, ...] | None
    image_size: tuple[int, int]

    def __post_init__(self) -> None:
        if self.views is not None:
            names = list(self.views)
            require(bool(names), VIEWS, "one or more views", names)
            require(len(set(names)) == len(names), VIEWS, "views that all differ", names)
        height, width = self.image_size
        wanted = f"[height, width] of at least {SMALLEST} pixels each and at most {MAX_PIXELS} in all"
        fits = min(height, width) >= SMALLEST and height * width <= MAX_PIXELS
        require(fits, SIZE, wanted, list(self.image_size))


def require_drawable(size: Sequence[int], largest: tuple[int, int]) -> None:
    """Raises UserError where pictures (H, W) [px] are larger than the buffer that they would be drawn into."""
    fits = size[0] <= largest[0] and size[1] <= largest[1]
    require(fits, SIZE, f"at most {list(largest)}, the buffer that pictures are drawn into", list(size))


def view_options(config: Mapping[str, Any]) -> ViewOptions:
    """What a policy sees, of a composed config or a run's. Raises UserError where `observation` is wrong."""
    seen = {name: part_of(config, f"observation.{name}") for name in ViewOptions.__slots__}
    return build(ViewOptions, seen, "observation")
