"""What a GPU would be waited for, counted without one: tensors of the device "meta" have no numbers to read."""

from collections import Counter
from contextlib import nullcontext
from dataclasses import fields

import pytest
import torch
import torch._dynamo.trace_rules  # looks functions up when it is imported, which must be before one is replaced
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from imfvla.command.composition import choices_of, compose
from imfvla.command.rehearsal import build_unfitted
from imfvla.draws import OwnStream
from imfvla.nn.compiled import compile_loss
from imfvla.policy.blank import blank_observation
from imfvla.training.parallel import DRAWS
from imfvla.training.precision import autocast
from imfvla.types import Batch, Observation

META = torch.device("meta")
SMALL = ("observation.image_size=[64,64]",)
SHALLOW = ("core.depth=1",)


class DrawsOnMeta(TorchFunctionMode):
    """Random numbers that are drawn where `rng` is come from the device "meta", which has no generators."""

    def __init__(self, rng: torch.Generator) -> None:
        super().__init__()
        self.rng, self.draws = rng, 0

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = dict(kwargs or {})
        if func in DRAWS and kwargs.get("generator") is self.rng:
            assert kwargs.pop("device", None) == self.rng.device, "a draw must say rng's device"
            kwargs["device"] = META
            self.draws += 1
        return func(*args, **kwargs)


class CopiesFromHost(TorchDispatchMode):
    """Counts copies of the host's tensors to the device, other than of single numbers."""

    def __init__(self) -> None:
        super().__init__()
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        moved = isinstance(result, torch.Tensor) and result.device == META
        tensors = [arg for arg in args if isinstance(arg, torch.Tensor)]
        if moved and any(tensor.device.type == "cpu" for tensor in tensors):
            self.found[str(func)] += 1
        return result


def batch_for(policy, rows: int = 2) -> Batch:
    one = blank_observation(policy)
    seen = Observation(*(getattr(one, field.name).repeat_interleave(rows, 0) for field in fields(one)))
    valid = torch.ones(rows, policy.horizon.pred, dtype=torch.bool)
    return Batch(seen, torch.zeros(rows, *policy.noise_shape), valid)


EVERY_LOSS = pytest.mark.parametrize(
    "overrides",
    [
        *(
            ["+exp=socket_ph32_exec16", f"generator={name}"]
            for name in choices_of("generator", "train")
            if name not in ("act", "smolvla", "flow_high_noise", "times")
        ),
        *([f"+exp={name}"] for name in ("socket_act", "socket_smolvla", "transfer_dit_ph16_exec16")),
        ["+exp=transfer_full_attnres_ph16_exec08", "core/conditioning=cross", "horizon.prefix_max=4"],
    ],
    ids=" ".join,
)


@EVERY_LOSS
def test_a_loss_neither_reads_numbers_nor_brings_them(overrides, monkeypatch):
    monkeypatch.setattr(torch, "is_autocast_enabled", lambda *_: False)  # which "meta" has not
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: nullcontext())
    policy = build_unfitted(compose("train", [*overrides, *SMALL])).train()
    batch = batch_for(policy).to(META)
    policy.to(META)
    rng, rehearsed = torch.Generator(), False
    for step in (0, 0, 90):  # of both stages, where there are two
        policy.begin_step(step, 100)
        with DrawsOnMeta(rng) as drawn, CopiesFromHost() as copies:
            loss, logs = policy.loss(batch, rng)  # reading a number would raise
            loss.backward()
        if rehearsed:  # what is kept on the device is brought there at the first step
            assert not copies.found
        rehearsed = True
        assert drawn.draws > 0 or not getattr(policy.generator, "uses_noise", True)
        assert {value.device for value in (loss, *logs.values())} == {META}


@EVERY_LOSS
def test_a_loss_is_one_graph_that_computes_the_same(overrides):
    policy = build_unfitted(compose("train", [*overrides, *SMALL, *SHALLOW])).train()
    batch, rng, graphs = batch_for(policy), OwnStream(torch.device("cpu")), []
    torch._dynamo.reset()
    eager = policy.loss
    assert compile_loss(policy, backend=lambda graph, _: graphs.append(graph) or graph)
    for step in range(2):  # one of each stage, where there are two
        policy.begin_step(step, 2)
        torch.manual_seed(0)
        expected, _ = eager(batch, rng)
        torch.manual_seed(0)
        found, _ = policy.loss(batch, rng)
        assert torch.equal(found, expected)
    assert len(graphs) == (2 if policy.has_stages else 1)


@pytest.mark.parametrize("generator", ["imf", "imf_plain", "flow", "ddpm", "l1"])
def test_autocast_casts_a_weight_once(generator):
    policy = build_unfitted(
        compose("train", ["+exp=socket_ph32_exec16", *SMALL, f"generator={generator}"])
    ).train()
    # Not the residuals' queries, vectors of which each sublayer reads its own.
    weights = {p.data_ptr(): name for name, p in policy.named_parameters() if name.endswith("weight")}
    casts: Counter[str] = Counter()

    class Casts(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            result = func(*args, **(kwargs or {}))
            if func is torch.ops.aten._to_copy.default and result.dtype == torch.bfloat16:
                casts[weights.get(args[0].data_ptr(), "")] += 1
            return result

    batch = batch_for(policy)
    with Casts(), autocast("bf16", torch.device("cpu")):
        policy.loss(batch, torch.Generator().manual_seed(0))
    casts.pop("", None)
    assert casts
    assert {name: count for name, count in casts.items() if count > 1} == {}
