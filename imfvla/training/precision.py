"""Which arithmetic the loss runs in: fp32, or bf16 autocast where it is measured to be faster."""

import time
from contextlib import AbstractContextManager, nullcontext

import torch
from torch.nn import functional as F

PRECISIONS = ("fp32", "bf16")
ADVANTAGE = 1.2  # bf16 must be this much faster to justify its rounding


def choose_precision(wanted: str, device: torch.device) -> str:
    """fp32 or bf16; `wanted` may be auto, which times a convolution and a matrix product in both."""
    if wanted != "auto":
        return wanted
    if device.type == "cuda":
        return "bf16" if torch.cuda.is_bf16_supported() else "fp32"
    return "bf16" if _work_s("fp32", device) > ADVANTAGE * _work_s("bf16", device) else "fp32"


def autocast(precision: str, device: torch.device) -> AbstractContextManager[None]:
    """The context in which the loss is computed."""
    return torch.autocast(device.type, torch.bfloat16) if precision == "bf16" else nullcontext()


def _work_s(precision: str, device: torch.device, repeats: int = 3) -> float:
    """Shortest time of a forward and backward pass like those of training."""
    generator = torch.Generator().manual_seed(0)
    images = torch.randn(16, 64, 24, 24, generator=generator).contiguous(memory_format=torch.channels_last)
    kernel = torch.randn(64, 64, 3, 3, generator=generator).requires_grad_()
    rows = torch.randn(2048, 256, generator=generator)
    matrix = torch.randn(512, 256, generator=generator).requires_grad_()
    times = []
    for _ in range(1 + repeats):
        start = time.perf_counter()
        with autocast(precision, device):
            total = F.conv2d(images, kernel, padding=1).float().mean() + F.linear(rows, matrix).float().mean()
        total.backward()
        times.append(time.perf_counter() - start)
    return min(times[1:])
