"""TF32 without a GPU: what is rounded, and how far a derivative is then off."""

import torch
from small_policy import batch as batch_of
from small_policy import policy as small_policy

from imfvla.benchmarks.rounding import RoundedProducts, derivative_errors, round_to_tf32


def test_ten_bits_of_a_fraction_are_kept():
    step = 2.0**-10
    given = torch.tensor(
        [1.0, 1 + step, 1 + 0.4 * step, 1 + 0.6 * step, 1 + 0.5 * step, 1 + 1.5 * step, -3.0, 0.0]
    )
    wanted = torch.tensor([1.0, 1 + step, 1.0, 1 + step, 1.0, 1 + 2 * step, -3.0, 0.0])
    assert torch.equal(round_to_tf32(given), wanted)
    drawn = torch.randn(1000)
    assert ((round_to_tf32(drawn) - drawn).abs() <= drawn.abs() * step / 2).all()


def test_products_round_their_inputs_and_nothing_else():
    a, b, shift = torch.randn(4, 8), torch.randn(8, 3), torch.randn(3)
    with RoundedProducts():
        product, affine, total = a @ b, torch.addmm(shift, a, b), a + a
        pictures = torch.nn.functional.conv2d(a.view(1, 1, 4, 8), b[:2, :2].reshape(1, 1, 2, 2))
    rounded = round_to_tf32(a) @ round_to_tf32(b)
    assert torch.equal(product, rounded)
    torch.testing.assert_close(affine, rounded + shift)
    assert torch.equal(total, a + a)
    kernel = round_to_tf32(b[:2, :2].reshape(1, 1, 2, 2))
    torch.testing.assert_close(
        pictures, torch.nn.functional.conv2d(round_to_tf32(a.view(1, 1, 4, 8)), kernel), rtol=1e-6, atol=1e-6
    )


def test_a_derivative_is_further_off_in_tf32_but_not_far():
    found = derivative_errors(small_policy().eval(), batch_of(8).obs)
    assert all(error < 1e-5 for error in found["fp32"].values())
    assert all(1e-5 < error < 1e-2 for error in found["tf32"].values())
