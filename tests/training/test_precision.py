import pytest
import torch

from imfvla.training import precision
from imfvla.training.precision import autocast, choose_precision

CPU = torch.device("cpu")


@pytest.mark.parametrize("wanted", ["fp32", "bf16"])
def test_a_wish_is_taken(wanted):
    assert choose_precision(wanted, CPU) == wanted


@pytest.mark.parametrize(("bf16_s", "expected"), [(0.5, "bf16"), (0.95, "fp32"), (2.0, "fp32")])
def test_auto_takes_what_is_clearly_faster(monkeypatch, bf16_s, expected):
    monkeypatch.setattr(precision, "_work_s", lambda name, device: {"fp32": 1.0, "bf16": bf16_s}[name])
    assert choose_precision("auto", CPU) == expected


def test_measures_both():
    assert all(precision._work_s(name, CPU, repeats=1) > 0 for name in ("fp32", "bf16"))


def test_autocast_rounds_products():
    matrix = torch.randn(8, 8)
    with autocast("bf16", CPU):
        assert (matrix @ matrix).dtype == torch.bfloat16
    with autocast("fp32", CPU):
        assert (matrix @ matrix).dtype == torch.float32
