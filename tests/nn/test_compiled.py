import copy

import pytest
import torch
from small_policy import batch, config, loss, policy

from imfvla.errors import UserError
from imfvla.nn import compiled


@pytest.fixture(autouse=True)
def forget_compiled_code():
    yield
    torch.compiler.reset()


def shallow_policy():
    """One block, since compiling takes seconds for each."""
    return policy(core=config()["core"] | {"depth": 1})


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


def test_a_compiled_loss_has_the_gradients_of_the_eager_one():
    made, data = shallow_policy(), batch()
    twin = compiled_copy(made, "aot_eager")
    losses = [loss(made, data), loss(twin, data)]
    torch.testing.assert_close(losses[1], losses[0])
    for value in losses:
        value.backward()
    assert list(twin.state_dict()) == list(made.state_dict())
    for (name, found), expected in zip(twin.named_parameters(), made.parameters(), strict=True):
        torch.testing.assert_close(found.grad, expected.grad, rtol=1e-4, atol=1e-6, msg=name)


def test_compiling_without_a_compiler_is_refused(monkeypatch):
    monkeypatch.setattr(compiled.shutil, "which", lambda name: None)
    with pytest.raises(UserError, match=r"needs a C\+\+ compiler"):
        compiled.compile_parts(policy())
