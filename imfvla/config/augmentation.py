"""The `augmentation` group of the config. Needs no torch."""

from dataclasses import dataclass

from imfvla.errors import UserError

MAX_GAIN = 1.98  # keeps (pixel - 128) * gain and its rounding within int16, as `data.augment` computes it
MAX_SHIFT_PX = 1000


@dataclass(frozen=True, slots=True)
class AugmentationOptions:
    """Random shifts and colours, drawn once for each sample and view and shared by all its observed steps.

    A shift moves the picture by up to `shift_px` pixels along each axis and repeats its edge (DrQ, arXiv
    2004.13649). Colours become `(x - 128) * gain + 128 + offset`, cut to 0 ... 255, with the gain drawn from
    `1 +- contrast` times, for each of R, G and B, `1 +- color`, and the offset from `+-brightness * 255`.
    """

    shift_px: int = 2
    brightness: float = 0.1
    contrast: float = 0.1
    color: float = 0.05

    def __post_init__(self) -> None:
        for name in ("shift_px", "brightness", "contrast", "color"):
            if getattr(self, name) < 0:
                raise UserError(f"augmentation.{name} must not be negative, found {getattr(self, name)}.")
        for name, limit in (("shift_px", MAX_SHIFT_PX), ("brightness", 1)):
            if getattr(self, name) > limit:
                raise UserError(f"augmentation.{name} must be at most {limit}, found {getattr(self, name)}.")
        if (gain := (1 + self.contrast) * (1 + self.color)) > MAX_GAIN:
            raise UserError(
                f"augmentation (1 + contrast) * (1 + color) must stay below {MAX_GAIN}, found {gain:.3g}; "
                "lower contrast or color."
            )
