"""What an observation shows: which cameras, and how large their pictures may be."""

from dataclasses import dataclass

from imfvla.options import require

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
