"""Image augmentation in integer arithmetic, so that a seed gives the same bytes on every machine.

Shapes: B batch, To observed steps, V views, H W pixels.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from imfvla.config.augmentation import AugmentationOptions
from imfvla.types import Batch

FRACTION_BITS = 7  # gains are multiples of 1/128
BLOCK = 4  # samples at a time: their int16 copies stay in the second-level cache


class Augmentation(AugmentationOptions):
    """Changes pictures as its options say."""

    __slots__ = ()

    def __call__(self, images: Tensor, rng: np.random.Generator) -> Tensor:
        """Augmented copy of uint8 images (B, To, V, 3, H, W)."""
        return self.draw(images, rng).apply(images)

    def draw(self, images: Tensor, rng: np.random.Generator) -> "Changes":
        """The changes of images (B, To, V, 3, H, W), of which only the numbers B and V matter."""
        b, v = images.shape[0], images.shape[2]
        shift = rng.integers(-self.shift_px, self.shift_px + 1, (b, v, 2))
        gain, offset = self._draw_colors(b, v, rng)
        recolors = bool(self.brightness or self.contrast or self.color)
        return Changes(*map(torch.from_numpy, (shift, gain, offset)), recolors)

    def _draw_colors(self, b: int, v: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """int16 gains in multiples of 1/128 and offsets, both broadcasting over (B, To, V, 3, H, W)."""
        contrast = 1 + rng.uniform(-self.contrast, self.contrast, (b, 1, v, 1, 1, 1))
        color = 1 + rng.uniform(-self.color, self.color, (b, 1, v, 3, 1, 1))
        offset = 128 + 255 * rng.uniform(-self.brightness, self.brightness, (b, 1, v, 1, 1, 1))
        gain = np.rint(contrast * color * 2**FRACTION_BITS)
        return gain.astype(np.int16), np.rint(offset).astype(np.int16)


@dataclass(frozen=True, slots=True)
class Changes:
    """What was drawn for the pictures of a batch, on their device."""

    shift: Tensor  # int64 (B, V, 2), down and right [px]
    gain: Tensor  # int16 (B, 1, V, 3, 1, 1), in multiples of 1/128
    offset: Tensor  # int16 (B, 1, V, 1, 1, 1)
    recolors: bool

    def apply(self, images: Tensor) -> Tensor:
        """Changed copy of uint8 images (B, To, V, 3, H, W): the same bytes on a CPU and elsewhere."""
        return self._on_cpu(images) if images.device.type == "cpu" else self.as_tensors(images)

    def map(self, function: Callable[[Tensor], Tensor]) -> "Changes":
        """With other tensors of the same content, such as those on another device."""
        return Changes(function(self.shift), function(self.gain), function(self.offset), self.recolors)

    def as_tensors(self, images: Tensor) -> Tensor:
        """`apply` in operators of tensors, without a wait for their device. On a CPU it takes several times as long."""
        b, to, v, _, height, width = images.shape
        rows, columns = (
            (torch.arange(size, device=images.device) - self.shift[..., axis, None]).clamp(0, size - 1)
            for axis, size in enumerate((height, width))
        )  # (B, V, H) and (B, V, W): the pixel that each one takes
        rows = rows[:, None, :, None, :, None].expand(b, to, v, 3, height, width)
        columns = columns[:, None, :, None, None, :].expand(b, to, v, 3, height, width)
        moved = images.gather(4, rows).gather(5, columns)
        if not self.recolors:
            return moved
        values = (moved.to(torch.int16) - 128) * self.gain + (1 << (FRACTION_BITS - 1))
        return ((values >> FRACTION_BITS) + self.offset).clamp(0, 255).to(torch.uint8)

    def _on_cpu(self, images: Tensor) -> Tensor:
        pixels, shift = images.numpy(), self.shift.numpy()
        augmented = np.empty_like(pixels)
        for sample in range(pixels.shape[0]):
            for view in range(pixels.shape[2]):
                _shift(pixels[sample, :, view], augmented[sample, :, view], *shift[sample, view])
        if self.recolors:
            _recolor(augmented, self.gain.numpy(), self.offset.numpy())
        return torch.from_numpy(augmented)


def changed(batch: Batch, changes: Changes | None) -> Batch:
    """A batch with `changes` of its pictures applied, both on one device; the batch itself for None."""
    if changes is None:
        return batch
    return replace(batch, obs=replace(batch.obs, images=changes.apply(batch.obs.images)))


def _shift(source: np.ndarray, target: np.ndarray, down: int, right: int) -> None:
    """Copies source (..., H, W) into target, moved by whole pixels, its edge repeated."""
    height, width = source.shape[-2:]
    top, bottom = max(down, 0), height + min(down, 0)
    left, end = max(right, 0), width + min(right, 0)
    target[..., top:bottom, left:end] = source[..., top - down : bottom - down, left - right : end - right]
    target[..., top:bottom, :left] = target[..., top:bottom, left : left + 1]
    target[..., top:bottom, end:] = target[..., top:bottom, end - 1 : end]
    target[..., :top, :] = target[..., top : top + 1, :]
    target[..., bottom:, :] = target[..., bottom - 1 : bottom, :]


def _recolor(pixels: np.ndarray, gain: np.ndarray, offset: np.ndarray) -> None:
    """In place `(pixels - 128) * gain / 128 + offset`, rounded and cut to uint8."""
    work = np.empty((BLOCK, *pixels.shape[1:]), np.int16)
    for first in range(0, len(pixels), BLOCK):
        block = slice(first, first + BLOCK)
        values = work[: len(pixels[block])]
        np.subtract(pixels[block], np.int16(128), out=values, dtype=np.int16)
        values *= gain[block]
        values += 1 << (FRACTION_BITS - 1)
        values >>= FRACTION_BITS
        values += offset[block]
        np.clip(values, 0, 255, out=values)
        pixels[block] = values
