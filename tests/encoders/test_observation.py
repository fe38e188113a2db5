from functools import partial

import pytest
import torch

from imfvla.encoders.observation import ObservationEncoder
from imfvla.encoders.tokens import AttendedTokens, GridTokens
from imfvla.encoders.vision import CompactCNN, CompactResNet, ResNet18
from imfvla.types import Observation, tokenize

TRUNKS = {
    "compact": lambda: CompactCNN((16, 16), 8),
    "compact_resnet": lambda: CompactResNet((16, 16), 8, num_blocks=2, residual="standard"),
    "compact_attnres": lambda: CompactResNet((16, 16), 8, num_blocks=2, residual="attention"),
    "resnet18": ResNet18,
    "resnet18_attnres": lambda: ResNet18("attention"),
}
TOKENS = {
    "grid": partial(GridTokens, tokens=2),
    "attended": partial(AttendedTokens, tokens=2, maps=4, features=3),
}


def encoder(trunk="compact", steps=1, tokens="grid"):
    torch.manual_seed(0)
    made = ObservationEncoder(
        vision=TRUNKS[trunk](),
        views=2,
        observed_steps=steps,
        state_dim=16,
        width=24,
        image_size=(64, 64),
        view_tokens=TOKENS[tokens],
    )
    made.fit(-torch.ones(16), torch.ones(16))
    return made


def observation(batch=3, steps=1, size=64):
    rng = torch.Generator().manual_seed(0)
    return Observation(
        torch.randint(0, 256, (batch, steps, 2, 3, size, size), generator=rng, dtype=torch.uint8),
        torch.rand(batch, steps, 16, generator=rng),
        torch.from_numpy(tokenize("put the peg in the socket")).expand(batch, -1),
    )


@pytest.mark.parametrize("trunk", TRUNKS)
@pytest.mark.parametrize("steps", [1, 2])
def test_tokens_count_views_states_and_one_sentence(trunk, steps):
    tokens = encoder(trunk, steps)(observation(steps=steps))
    assert tokens.shape == (3, steps * (2 * 2 + 1) + 2, 24)
    assert tokens.isfinite().all()


@pytest.mark.parametrize("trunk", TRUNKS)
def test_trunks_shrink_pictures_by_their_stride(trunk):
    vision = TRUNKS[trunk]()
    side = 64 // vision.stride
    assert vision(torch.rand(2, 3, 64, 64)).shape == (2, vision.channels, side, side)


def test_rows_do_not_see_each_other():
    made, obs = encoder(), observation()
    alone = Observation(obs.images[1:2], obs.state[1:2], obs.instruction[1:2])
    torch.testing.assert_close(made(obs)[1:2], made(alone), rtol=1e-4, atol=1e-5)


def test_every_part_of_an_observation_matters():
    made, obs = encoder(), observation()
    base = made(obs)
    for changed in (
        Observation(255 - obs.images, obs.state, obs.instruction),
        Observation(obs.images, obs.state + 0.1, obs.instruction),
        Observation(obs.images, obs.state, torch.from_numpy(tokenize("hand it over")).expand(3, -1)),
    ):
        assert not torch.allclose(made(changed), base)


@pytest.mark.parametrize("tokens", TOKENS)
def test_every_parameter_learns(tokens):
    made = encoder(tokens=tokens)
    made(observation()).square().sum().backward()
    assert [name for name, p in made.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_a_bright_spot_is_located_where_it_is():
    """With one map that follows the brightness, the pooled position is the spot's."""
    tokens = AttendedTokens(views=1, channels=1, grid=(5, 5), tokens=1, maps=1, features=1, width=3)
    with torch.no_grad():
        tokens.maps.fill_(1.0)
        tokens.sharpness.fill_(100.0)
        tokens.output.copy_(torch.eye(3))
        tokens.identity.zero_()
    x = torch.zeros(1, 1, 1, 5, 5)
    x[..., 3, 0] = 1.0
    torch.testing.assert_close(tokens(x)[0, 0, 1:], torch.tensor([0.5, -1.0]))


@pytest.mark.parametrize("tokens", TOKENS)
def test_a_small_object_on_a_plain_table_stands_out_before_any_training(tokens):
    """Moving it changes the tokens about as much as they measure, whatever the background's brightness."""
    torch.manual_seed(0)
    made = encoder(tokens=tokens)
    pictures = torch.full((2, 1, 2, 3, 64, 64), 190, dtype=torch.uint8)
    for row, (top, left) in enumerate(((8, 8), (40, 48))):
        pictures[row, ..., top : top + 6, left : left + 10] = torch.tensor([250, 120, 20])[:, None, None]
    same = torch.zeros(2, 1, 16), torch.zeros(2, 16, dtype=torch.int64)
    tokens = made(Observation(pictures, *same))[:, :4]
    assert (tokens[0] - tokens[1]).norm() > 0.3 * tokens[0].norm()


def test_maps_must_be_shared_evenly_by_tokens():
    with pytest.raises(ValueError, match="5 attention maps cannot be shared evenly by 2 tokens"):
        AttendedTokens(views=1, channels=1, grid=(5, 5), tokens=2, maps=5, features=1, width=3)
