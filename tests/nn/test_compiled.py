import copy
import os
from types import SimpleNamespace

import pytest
import torch
from small_policy import batch, config, loss, policy

from imfvla.errors import UserError
from imfvla.nn import compiled


@pytest.fixture(autouse=True)
def forget_compiled_code():
    yield
    torch.compiler.reset()


def shallow_policy(v_from="boundary"):
    """One block, since compiling takes seconds for each."""
    core = config()["core"] | {"depth": 1, "velocity_head": v_from == "head"}
    return policy(core=core, generator=config()["generator"] | {"v_from": v_from})


def compiled_copy(made, backend):
    twin = copy.deepcopy(made)
    compiled.compile_parts(twin, backend)
    return twin


@pytest.mark.skipif(not compiled.has_compiler(), reason="no C++ compiler is installed")
@torch.inference_mode()
def test_a_compiled_policy_predicts_what_the_eager_one_does():
    made, data = shallow_policy().eval(), batch()
    twin = compiled_copy(made, "inductor")
    noise = torch.randn(3, 8, 16, generator=torch.Generator().manual_seed(0))
    for nfe in (1, 2):
        expected = made.predict(data.obs, noise, nfe)
        assert (twin.predict(data.obs, noise, nfe) - expected).abs().max() < 1e-4


@pytest.mark.parametrize("v_from", ["boundary", "head"])
def test_a_compiled_loss_has_the_gradients_of_the_eager_one(v_from):
    made, data = shallow_policy(v_from), batch()
    twin = compiled_copy(made, "aot_eager")
    losses = [loss(made, data), loss(twin, data)]
    torch.testing.assert_close(losses[1], losses[0])
    for value in losses:
        value.backward()
    assert list(twin.state_dict()) == list(made.state_dict())
    for (name, found), expected in zip(twin.named_parameters(), made.parameters(), strict=True):
        torch.testing.assert_close(found.grad, expected.grad, rtol=1e-4, atol=1e-6, msg=name)


def test_without_a_compiler_a_policy_stays_as_it_is_and_a_line_says_so(monkeypatch, caplog):
    monkeypatch.setattr(compiled.shutil, "which", lambda name: None)
    made = policy()
    compiled.compile_parts(made)
    assert "condition" not in vars(made.core)
    assert "no C++ compiler was found" in caplog.text


def test_compiled_code_lies_in_the_users_cache_unless_the_user_says_where(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "has_compiler", lambda: True)
    chosen = str(tmp_path / "chosen")
    monkeypatch.setenv(compiled.CACHE, chosen)
    compiled.compile_parts(policy())
    assert os.environ[compiled.CACHE] == chosen
    monkeypatch.delenv(compiled.CACHE)
    compiled.compile_parts(policy())
    assert os.environ[compiled.CACHE] == str(tmp_path / "imfvla" / "inductor")


def test_a_loss_that_is_no_graph_is_refused_with_what_to_do():
    made = SimpleNamespace(loss=lambda batch, rng: (batch + torch.randn(3, generator=rng), {}))
    assert compiled.compile_loss(made, backend="eager")
    with pytest.raises(UserError, match=r"one graph .* cannot be: .* imfvla\.draws\.draw, .*compile=false"):
        made.loss(torch.ones(3), torch.Generator())
