"""Diffusion against known values, a plain numpy version, Gaussian data, and diffusers where it is installed."""

import importlib.util

import numpy as np
import pytest
import torch
from closed_forms import MEAN, STD, STEPS, Context, Recorded, draw
from torch import nn

from imfvla.errors import UserError
from imfvla.generators import ddpm
from imfvla.generators.base import adapted, ancestral_noise
from imfvla.generators.ddpm import DenoisingDiffusion, squared_cosine, trailing_levels

LEVELS = 100
PREDICTIONS = ["epsilon", "sample", "v"]
every_prediction = pytest.mark.parametrize("prediction", PREDICTIONS)


def generator(**changes):
    options = {
        "num_levels": LEVELS,
        "prediction": "epsilon",
        "clip_sample": False,
        "draws": 1,
        "clip": 1e6,
    }
    return DenoisingDiffusion(**(options | changes))


class GaussianDenoiser(nn.Module):
    """The exact conditional mean of what is predicted, for data N(m, diag s^2)."""

    def __init__(self, prediction):
        super().__init__()
        self.prediction, self.kept = prediction, squared_cosine(LEVELS)

    def forward(self, z, t, r, context):
        assert torch.equal(t, r)
        kept = self.kept[(t * LEVELS).round().long() - 1][:, None, None]
        surprise = (z - kept.sqrt() * MEAN) / (kept * STD**2 + 1 - kept)
        noise, x = (1 - kept).sqrt() * surprise, MEAN + kept.sqrt() * STD**2 * surprise
        v = kept.sqrt() * noise - (1 - kept).sqrt() * x
        return {"epsilon": noise, "sample": x, "v": v}[self.prediction]


def plain_sample(predict_noise, noise, later, nfe, clip):
    """DDPM (nfe = 100) or DDIM, written down as in the papers: float64 arrays, `later` (99, B, H, A)."""
    edges = np.cos((np.arange(LEVELS + 1) / LEVELS + 0.008) / 1.008 * np.pi / 2) ** 2
    betas = np.minimum(1 - edges[1:] / edges[:-1], 0.999)
    bars = np.cumprod(1 - betas)
    levels = np.round(np.arange(LEVELS, 0, -LEVELS / nfe)).astype(int) - 1
    z = noise
    for index, k in enumerate(levels):
        e = predict_noise(z, k)
        x = np.clip((z - np.sqrt(1 - bars[k]) * e) / np.sqrt(bars[k]), -clip, clip)
        before = bars[levels[index + 1]] if index + 1 < nfe else 1.0
        if nfe < LEVELS:
            z = np.sqrt(before) * x + np.sqrt(1 - before) * e
            continue
        of_x = np.sqrt(before) * betas[k] / (1 - bars[k])
        of_z = np.sqrt(1 - betas[k]) * (1 - before) / (1 - bars[k])
        z = of_x * x + of_z * z
        if k > 0:
            z = z + np.sqrt((1 - before) / (1 - bars[k]) * betas[k]) * later[index]
    return z


def test_the_schedule_has_its_known_values():
    """As diffusers 0.42 prints them, in float32."""
    kept = squared_cosine(LEVELS)
    betas = 1 - kept / torch.cat((torch.ones(1, dtype=kept.dtype), kept[:-1]))
    assert kept.dtype == torch.float64
    assert betas[[0, 50, 98, 99]].tolist() == pytest.approx(
        [6.312816e-4, 3.154634e-2, 0.7499393, 0.999], rel=1e-5
    )
    assert kept[[0, 50, 98, 99]].tolist() == pytest.approx(
        [0.9993687, 0.4782646, 2.428572e-4, 2.428541e-7], rel=1e-4
    )


@pytest.mark.parametrize(
    ("nfe", "levels"), [(1, [99]), (2, [99, 49]), (3, [99, 66, 32]), (100, list(range(99, -1, -1)))]
)
def test_levels_trail_from_the_noisiest_one(nfe, levels):
    assert trailing_levels(LEVELS, nfe) == levels


@pytest.mark.parametrize(("nfe", "levels"), [(1, [99]), (2, [99, 29]), (4, [99, 76, 52, 29])])
def test_the_last_of_several_steps_starts_at_a_given_share_of_the_levels(nfe, levels):
    assert trailing_levels(100, nfe, 0.3) == levels


@pytest.mark.parametrize("nfe", [1, 2, 3, 10, 99, 100])
@pytest.mark.parametrize("clip", [1.0, 1e6])
def test_sampling_equals_the_plain_version(nfe, clip):
    core, noise = Recorded(), draw(4)[0]

    def predict_noise(z, k):
        t = torch.full((len(z),), (k + 1) / LEVELS, dtype=torch.float64)
        return core(torch.from_numpy(z), t, t, None).numpy()

    with torch.inference_mode():
        found = generator(clip_sample=True, clip=clip).sample(core, None, noise, nfe)
        expected = plain_sample(
            predict_noise, noise.numpy(), ancestral_noise(noise, LEVELS - 1).numpy(), nfe, clip
        )
    torch.testing.assert_close(found, torch.from_numpy(expected), rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize(
    ("prediction", "gain", "nfe", "expected"),
    [
        ("epsilon", 0.9, 2, 0.851306),
        ("epsilon", 0.9, 100, 0.00085727),
        ("sample", 0.3, 2, 0.414974),
        ("sample", 0.6, 100, 9.35491e-05),
        ("v", 0.1, 2, 0.607804),
        ("v", 0.1, 100, 0.000514965),
    ],
)
def test_sampling_gives_the_values_of_diffusers_0_42(prediction, gain, nfe, expected, monkeypatch):
    """From z = 1.5 with a core that returns gain * z, the ancestral steps without their noise."""

    class Gain(nn.Module):
        def forward(self, x, t, r, context):
            return gain * x

    monkeypatch.setattr(ddpm, "ancestral_noise", lambda noise, count: noise.new_zeros(count, *noise.shape))
    gen = generator(prediction=prediction, clip_sample=True, clip=1.0)
    found = gen.sample(Gain(), None, torch.full((1, 1, 1), 1.5, dtype=torch.float64), nfe)
    assert found.item() == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("nfe", [1, 5, 100])
def test_all_predictions_give_the_same_sample(nfe):
    noise, _, _ = draw()
    first, *others = (
        generator(prediction=prediction).sample(GaussianDenoiser(prediction), None, noise, nfe)
        for prediction in PREDICTIONS
    )
    for other in others:
        torch.testing.assert_close(other, first, rtol=1e-6, atol=1e-6)


@every_prediction
def test_one_trailing_step_gives_the_mean_whatever_the_noise(prediction):
    sample = generator(prediction=prediction).sample(GaussianDenoiser(prediction), None, draw()[0], 1)
    torch.testing.assert_close(sample, MEAN.expand_as(sample), rtol=0, atol=3e-3)


def test_many_steps_without_noise_follow_the_flow():
    noise, _, _ = draw()
    sample = generator().sample(GaussianDenoiser("epsilon"), None, noise, 99)
    assert (sample - (MEAN + STD * noise)).abs().max() < 0.1


def test_ancestral_samples_have_the_moments_of_the_data():
    noise, _, _ = draw(2000)
    sample = generator().sample(GaussianDenoiser("epsilon"), None, noise, LEVELS)
    torch.testing.assert_close(sample.mean(0), MEAN, rtol=0, atol=0.1)
    torch.testing.assert_close(sample.std(0), STD, rtol=0.1, atol=0)
    # the noise of later steps matters too
    assert torch.corrcoef(torch.stack((sample.flatten(), noise.flatten())))[0, 1] < 0.9


def test_later_noise_follows_from_the_first_row_by_row():
    noise, _, _ = draw(200)
    later = ancestral_noise(noise, 50)
    assert later.shape == (50, *noise.shape)
    assert later.dtype == noise.dtype
    torch.manual_seed(0)
    assert torch.equal(later[:, 7:9], ancestral_noise(noise[7:9], 50))
    assert abs(later.mean()) < 0.02
    assert abs(later.std() - 1) < 0.02
    moved = noise[:1].clone()
    moved[0, 0, 0] += 1e-6
    assert not torch.equal(ancestral_noise(moved, 50), later[:, :1])


@every_prediction
def test_the_loss_is_the_squared_error_of_what_is_predicted(prediction):
    core, actions = Recorded(), MEAN + STD * draw(8)[0]
    valid = torch.ones(8, STEPS, dtype=torch.bool)
    valid[0, 1:] = False
    gen = generator(prediction=prediction, draws=2)
    found, _ = gen.loss(core, Context(), actions, valid, torch.Generator().manual_seed(4))

    rng = torch.Generator().manual_seed(4)
    x = actions.repeat_interleave(2, dim=0)
    noise = torch.randn(x.shape, generator=rng).to(x)
    k = torch.randint(LEVELS, (16,), generator=rng)
    kept = squared_cosine(LEVELS)[k][:, None, None]
    t = (k + 1).double() / LEVELS
    output = core(kept.sqrt() * x + (1 - kept).sqrt() * noise, t, t, None)
    v = kept.sqrt() * noise - (1 - kept).sqrt() * x
    error = (output - {"epsilon": noise, "sample": x, "v": v}[prediction]).square().mean(-1)
    rows = valid.repeat_interleave(2, dim=0)
    expected = ((error * rows).sum(1) / rows.sum(1)).reshape(8, 2).mean(1)
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("changes", [{"prediction": "score"}, {"num_levels": 0}, {"draws": 0}])
def test_impossible_choices_are_refused_by_name(changes):
    with pytest.raises(UserError, match=f"generator.{next(iter(changes))}"):
        generator(**changes)


def test_more_steps_than_levels_are_refused():
    with pytest.raises(UserError, match=r"between 1 and generator\.num_levels=100, found 101"):
        generator().sample(GaussianDenoiser("epsilon"), None, draw(2)[0], 101)


if importlib.util.find_spec("diffusers"):
    from diffusers.schedulers import scheduling_ddim, scheduling_ddpm

    TYPES = {"epsilon": "epsilon", "sample": "sample", "v": "v_prediction"}

    @every_prediction
    @pytest.mark.parametrize("nfe", [1, 2, 10, 50, 100])
    def test_sampling_equals_diffusers(prediction, nfe, monkeypatch):
        core, noise = Recorded(), draw(4)[0]
        later = iter(ancestral_noise(noise, LEVELS - 1))
        monkeypatch.setattr(scheduling_ddpm, "randn_tensor", lambda *args, **options: next(later))
        options = {
            "num_train_timesteps": LEVELS,
            "beta_schedule": "squaredcos_cap_v2",
            "prediction_type": TYPES[prediction],
            "timestep_spacing": "trailing",
        }
        if nfe == LEVELS:
            scheduler = scheduling_ddpm.DDPMScheduler(variance_type="fixed_small", **options)
        else:
            scheduler = scheduling_ddim.DDIMScheduler(**options)
        scheduler.set_timesteps(nfe)
        z = noise
        with torch.inference_mode():
            for k in scheduler.timesteps:
                t = ((k + 1) / LEVELS).double().expand(len(z))
                z = scheduler.step(core(z, t, t, None), k, z).prev_sample
            found = generator(prediction=prediction, clip_sample=True, clip=1.0).sample(
                core, None, noise, nfe
            )
        torch.testing.assert_close(found, z.clamp(-1, 1), rtol=1e-4, atol=1e-4)

    def test_the_schedule_equals_diffusers():
        reference = scheduling_ddpm.DDPMScheduler(
            num_train_timesteps=LEVELS, beta_schedule="squaredcos_cap_v2"
        )
        torch.testing.assert_close(
            squared_cosine(LEVELS).float(), reference.alphas_cumprod, rtol=1e-4, atol=1e-9
        )


def test_half_the_adaptive_power_is_the_pseudo_huber_loss():
    """error / sg(error + c)^(1/2) has the gradient of 2 sqrt(error + c)."""
    error = torch.tensor([0.0, 1e-4, 0.1, 30.0], dtype=torch.float64, requires_grad=True)
    (found,) = torch.autograd.grad(adapted(error, 0.5, 1e-3).sum(), error)
    (expected,) = torch.autograd.grad(2 * (error + 1e-3).sqrt().sum(), error)
    torch.testing.assert_close(found, expected)


def test_an_adaptive_power_makes_one_far_chunk_count_for_less():
    """Of two chunks, one of which is far from what is predicted."""
    actions, valid = torch.zeros(2, *MEAN.shape, dtype=torch.float64), torch.ones(2, STEPS, dtype=torch.bool)
    actions[1] += 100
    plain, counted = (
        generator(prediction="sample", adaptive_power=power).loss(
            Nothing(), Context(), actions, valid, stream()
        )[0]
        for power in (0.0, 0.5)
    )
    torch.testing.assert_close(plain, torch.tensor([0.0, 1e4], dtype=torch.float64))
    torch.testing.assert_close(counted, plain / (plain + 1e-3).sqrt())


class Nothing(nn.Module):
    """Predicts 0."""

    def forward(self, z, t, r, context):
        return torch.zeros_like(z)


def stream():
    return torch.Generator().manual_seed(0)
