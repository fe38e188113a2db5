"""Several processes compute what one computes: each takes its rows and their random numbers."""

from dataclasses import replace

import pytest
import torch
from processes import Job, assert_close, launch, train
from synthetic import write_demonstrations
from tiny_policy import OPTIONS, CountedBatches
from torch.nn import functional as F

from imfvla.command.composition import compose
from imfvla.errors import UserError
from imfvla.policy import build_policy
from imfvla.training.parallel import Alone, Shared, WholeBatchDraws, rows
from imfvla.types import Batch, Observation


def test_two_processes_equal_one_and_one_resumes_from_what_they_began(tmp_path, make_trainer):
    make_trainer(tmp_path / "one", steps=6, log_every=1).train()
    jobs = [Job(str(tmp_path / "two")), Job(str(tmp_path / "mixed"), stops_before=2)]
    launch(jobs, tmp_path / "jobs.json")
    assert_close(tmp_path / "two", tmp_path / "one")
    assert train(Job(str(tmp_path / "mixed")), Alone()) == 3
    assert_close(tmp_path / "mixed", tmp_path / "one")


def test_compiled_code_computes_in_shares_and_parts_what_the_whole_computes_eagerly(tmp_path):
    """Two processes with two parts of a batch each."""
    sizes = ["size.width=32", "size.heads=2", "size.depth=2", "observation.image_size=[32,32]"]
    options = ["batch_size=4", "steps=2", "checkpoints=1", "log_every=1", "threads=1", "precision=fp32"]
    overrides = [*sizes, *(f"training.{option}" for option in options)]
    demos = str(write_demonstrations(tmp_path / "demonstrations"))
    eager = Job(str(tmp_path / "eager"), overrides=overrides, demos=demos)
    train(eager, Alone())
    compiled = [*overrides, "training.compile=true", "training.accumulate=2"]
    job = replace(eager, run=str(tmp_path / "compiled"), overrides=compiled, backend="aot_eager")
    launch([job], tmp_path / "jobs.json")
    assert_close(tmp_path / "compiled", tmp_path / "eager", steps=2)


@pytest.mark.parametrize("func", [torch.rand, torch.randn])
@pytest.mark.parametrize("shape", [(6,), (2, 3), ((4, 3, 2),), (3,)])
def test_each_process_keeps_its_rows_of_what_all_draw(func, shape):
    def draw(mode):
        rng = torch.Generator().manual_seed(3)
        with WholeBatchDraws(rng, 2, *mode):
            return func(*shape, generator=rng), torch.randint(9, (2,), generator=rng)

    whole = draw((0, 1))
    lengths = torch.empty(shape[0] if isinstance(shape[0], tuple) else shape)
    parts = [draw((rank, 3)) for rank in range(3)]
    if len(lengths) % 2:  # of no rows: alike for all
        assert all(torch.equal(part[0], whole[0]) for part in parts)
        return
    rng = torch.Generator().manual_seed(3)
    expected = func(3 * len(lengths), *lengths.shape[1:], generator=rng)
    assert torch.equal(torch.cat([part[0] for part in parts]), expected)
    assert torch.equal(torch.cat([part[1] for part in parts]), torch.randint(9, (6,), generator=rng))


def test_dropout_is_that_of_the_whole_batch():
    torch.manual_seed(1)
    inputs = torch.randn(6, 5)
    torch.manual_seed(2)
    whole = F.dropout(inputs, 0.5)
    parts = []
    for rank in range(3):
        torch.manual_seed(2)
        with WholeBatchDraws(torch.Generator(), 2, rank, 3):
            parts.append(torch.nn.Dropout(0.5)(inputs[2 * rank : 2 * rank + 2]))
    assert torch.equal(torch.cat(parts), whole)


def batch_of(count: int) -> Batch:
    rng = torch.Generator().manual_seed(0)
    observation = Observation(
        images=torch.randint(256, (count, 1, 3, 3, 32, 32), dtype=torch.uint8, generator=rng),
        state=torch.rand(count, 1, 16, generator=rng),
        instruction=torch.ones(count, 16, dtype=torch.int64),
    )
    return Batch(
        observation, torch.rand(count, 32, 16, generator=rng), torch.ones(count, 32, dtype=torch.bool)
    )


@pytest.mark.parametrize("generator", ["imf", "meanflow", "flow", "ddpm", "l1"])
def test_gradients_of_shares_average_to_those_of_the_batch(generator):
    """The loss with its derivative along the flow, taken twice on halves, is the loss of the whole."""
    from imfvla.data.statistics import Statistics

    torch.manual_seed(0)
    config = compose("train", ["observation.image_size=[32,32]", f"generator={generator}"])
    batch = batch_of(4)
    ones = batch.actions[:, 0].numpy()
    policy = build_policy(
        config,
        Statistics.of(ones, ones, batch.actions.numpy() - ones[:, None], batch.valid.numpy()),
    )

    def gradients(share: Batch, rank: int, size: int) -> dict[str, torch.Tensor]:
        policy.zero_grad(set_to_none=True)
        rng = torch.Generator().manual_seed(5)
        with WholeBatchDraws(rng, len(share.actions), rank, size):
            policy.loss(share, rng)[0].backward()
        return {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}

    whole = gradients(batch, 0, 1)
    halves = [gradients(rows(batch, slice(2 * rank, 2 * rank + 2)), rank, 2) for rank in range(2)]
    assert whole.keys() == halves[0].keys()
    for name, gradient in whole.items():
        torch.testing.assert_close((halves[0][name] + halves[1][name]) / 2, gradient, rtol=1e-3, atol=1e-5)


def test_a_batch_that_cannot_be_shared_out_is_refused():
    with pytest.raises(UserError, match=r"batch_size must be a multiple of the 3 processes, found 8"):
        Shared(0, 3, 3).check(OPTIONS)
    with pytest.raises(
        UserError, match=r"compile must be auto or false with training\.sharding=full, found true"
    ):
        Shared(0, 2, 2).check(replace(OPTIONS, compile=True, sharding="full"))
    with pytest.raises(UserError, match=r"training\.sharding=full needs several processes, found one"):
        Alone().check(replace(OPTIONS, sharding="full"))
    Alone().check(replace(OPTIONS, batch_size=7))
    assert len(Shared(1, 2, 2).share(next(CountedBatches())).actions) == 4
