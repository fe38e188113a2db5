"""Which arithmetic the loss runs in: fp32, bf16 autocast where it is measured to be faster, or TF32 where it is chosen.

TF32 multiplies numbers of 10 bits (fp32 has 23, bf16 7) in the matrix products and convolutions of a GPU, in those of
the Jacobian-vector product too, which autocast leaves alone: `benchmarks/rounding.py` measures its error.
"""

import time
from contextlib import AbstractContextManager, nullcontext

import torch
from torch.nn import functional as F

from imfvla.options import require

FP32, BF16, TF32 = PRECISIONS = ("fp32", "bf16", "tf32")
ADVANTAGE = 1.2  # bf16 must be this much faster to justify its rounding


def choose_precision(wanted: str, device: torch.device) -> str:
    """One of PRECISIONS; `wanted` may be auto, which times a convolution and a matrix product in fp32 and bf16.

    Raises UserError where TF32 is wanted and the device is no GPU.
    """
    on_gpu = device.type == "cuda"
    require(on_gpu or wanted != TF32, "training.precision", f"another than {TF32} on {device.type}", wanted)
    if wanted != "auto":
        return wanted
    if on_gpu:
        return BF16 if torch.cuda.is_bf16_supported() else FP32
    return BF16 if _work_s(FP32, device) > ADVANTAGE * _work_s(BF16, device) else FP32


def allow_tf32(precision: str) -> None:
    """Lets products of this process be of TF32, or forbids it. Elsewhere than on a GPU nothing changes."""
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == TF32


def autocast(precision: str, device: torch.device) -> AbstractContextManager[None]:
    """The context in which the loss is computed."""
    return torch.autocast(device.type, torch.bfloat16) if precision == BF16 else nullcontext()


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
