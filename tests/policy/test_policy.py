import numpy as np
import pytest
import torch
from small_policy import batch, config, loss, policy

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.policy import build_policy, hold_last
from imfvla.types import MAX_WORDS, NUM_WORD_IDS, Batch, tokenize


def test_loss_is_unchanged_by_garbage_in_padded_steps():
    made, data = policy(), batch()
    garbage = data.actions.clone()
    garbage[~data.valid] = torch.nan
    assert torch.equal(loss(made, data), loss(made, Batch(data.obs, garbage, data.valid)))


def test_steps_that_are_not_valid_repeat_the_last_action_before_them():
    valid = torch.tensor([[True, True, False, False], [True, True, True, True]])
    actions = torch.tensor([[1.0, 2.0, torch.nan, 9.0], [1.0, 2.0, 3.0, 4.0]]).unsqueeze(-1)
    held = hold_last(actions, valid).squeeze(-1)
    assert held.tolist() == [[1.0, 2.0, 2.0, 2.0], [1.0, 2.0, 3.0, 4.0]]


def test_what_a_generator_sees_behind_an_episode_s_end_is_the_held_action_not_the_mean():
    made, data = policy(), batch()
    seen = []
    made.generator.loss = lambda core, context, actions, *_: (seen.append(actions), actions.mean((1, 2)), {})[
        1:
    ]
    loss(made, data)
    chunk = made.chunks.denormalise(seen[0], data.obs.state[:, -1])
    torch.testing.assert_close(chunk[-1, 5:], data.actions[-1, 4].expand(3, -1))


@pytest.mark.parametrize(
    "groups",
    [
        ["generator=act"],
        ["core=act"],
        ["generator=flow_high_noise", "core.velocity_head=true"],
        ["generator=imf_plain", "generator.v_from=head"],
        ["generator=imf", "core.velocity_head=false"],
    ],
)
def test_a_generator_and_a_core_that_do_not_fit_are_refused(groups):
    with pytest.raises(
        UserError, match=r"^generator imfvla\.generators\..* core imfvla\.nn\..*: core=act goes"
    ):
        build_policy(compose("train", groups))


def test_an_encoder_and_a_core_that_do_not_fit_are_refused():
    message = r"^encoder imfvla\.encoders\..* core imfvla\.nn\..* wants the .* there: core=smolvla goes with"
    with pytest.raises(UserError, match=message):
        build_policy(compose("train", ["core=smolvla", "generator=smolvla"]))


def test_loss_is_a_pure_function_of_batch_and_generator():
    made, data = policy(), batch()
    assert torch.equal(loss(made, data), loss(made, data))
    scalar, logs = made.loss(data, torch.Generator().manual_seed(1))
    assert scalar.shape == ()
    assert all(value.shape == () and value.isfinite() for value in logs.values())


@pytest.mark.parametrize("nfe", [1, 2, 3])
def test_predictions_lie_in_the_range_of_the_demonstrated_actions(nfe):
    made, data = policy(), batch()
    noise = 10 * torch.randn(3, *made.noise_shape, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        chunk = made.predict(data.obs, noise, nfe)
        assert torch.equal(chunk, made.predict(data.obs, noise, nfe))
    assert chunk.shape == (3, 8, 16)
    assert ((chunk >= -3) & (chunk <= 1)).all()
    assert not torch.equal(chunk[0], chunk[1])


def test_rows_of_noise_share_the_observation_that_they_lie_beside():
    made, data = policy(), batch()
    noise = torch.randn(6, *made.noise_shape, generator=torch.Generator().manual_seed(2))
    with torch.inference_mode():
        together = made.predict(data.obs, noise, 2)
        apart = torch.stack([made.predict(data.obs, noise[k::2], 2) for k in range(2)], dim=1)
    assert torch.allclose(together, apart.flatten(0, 1), atol=1e-5)


def test_a_policy_without_statistics_predicts_nothing_that_looks_valid():
    made, data = policy(statistics=None), batch()
    assert made.predict(data.obs, torch.zeros(3, 8, 16), 1).isnan().all()


def test_noise_of_another_scale_is_refused_where_later_steps_draw_their_own():
    made = build_policy(compose("train", ["generator=ddpm"]))
    made.check_sampling(100, 1.0)
    made.check_sampling(10, 0.0)
    with pytest.raises(
        UserError, match=r"^noise_scale must be 1 with nfe=100, found 0\.5: .* draws noise in later"
    ):
        made.check_sampling(100, 0.5)


def test_no_evaluation_is_refused():
    with pytest.raises(UserError, match="at least 1, found 0"):
        policy().predict(batch().obs, torch.zeros(3, 8, 16), 0)


def test_parts_that_do_not_fit_are_refused_in_one_sentence():
    odd = config()
    odd["core"] = odd["core"] | {"patch": 3}
    with pytest.raises(UserError, match=r"core\.patch must divide the 8 steps of horizon\.pred"):
        build_policy(odd)
    odd["core"] = config()["core"]
    odd["generator"] = odd["generator"] | {"compound_draws": 3}
    with pytest.raises(
        UserError, match=r"^generator\.compound_draws must lie between 1 and generator\.draws=2, found 3\.$"
    ):
        build_policy(odd)
    with pytest.raises(UserError, match=r"exec must not exceed horizon\.pred"):
        build_policy(config(horizon={"obs": 1, "pred": 8, "exec": 9}))
    lacking = config()
    del lacking["core"]
    with pytest.raises(UserError, match="lacks the key 'core'"):
        build_policy(lacking)


def test_words_become_the_same_ids_everywhere():
    ids = tokenize("Put the peg into the socket!")
    assert ids.shape == (MAX_WORDS,)
    assert ids.dtype == np.int64
    assert np.array_equal(ids, tokenize("put  the peg, into the SOCKET"))
    assert ids[1] == ids[4] > 0
    assert (ids[6:] == 0).all()
    assert (tokenize("word " * 40) > 0).all()
    assert ids.max() < NUM_WORD_IDS
