import pytest
import torch
from torch import nn

from imfvla.nn.forward_mode import jvp
from imfvla.nn.smolvla import SmolVLACore

BATCH, STEPS, CHANNELS, TOKENS, WIDTH = 2, 5, 3, 6, 12


def make_core(depth=4):
    torch.manual_seed(0)
    core = SmolVLACore(
        steps=STEPS, channels=CHANNELS, width=WIDTH, expert_width=8, depth=depth, heads=2, mlp_ratio=2.0,
        max_rad=10.0, pretrained=None, frozen=False,
    ).double()  # fmt: skip
    nn.init.normal_(core.output.weight, std=0.3)
    return core.requires_grad_(False)


def inputs():
    rng = torch.Generator().manual_seed(1)
    shapes = ((STEPS, CHANNELS), (TOKENS, WIDTH))
    x, context = (torch.randn(BATCH, *shape, generator=rng, dtype=torch.float64) for shape in shapes)
    t = torch.tensor([0.9, 0.4], dtype=torch.float64)
    return x, t, t / 2, context


@pytest.mark.parametrize("depth", [1, 4])
def test_the_cached_prefix_gives_what_one_joint_pass_gives(depth):
    """The expert's layers beside the prefix's, everything recomputed, in masked attention over both."""
    core = make_core(depth)
    x, t, r, context = inputs()
    times = torch.cat((core.time(t), core.interval(t - r)), -1).unsqueeze(1).expand(-1, STEPS, -1)
    actions = core.mlp(torch.cat((core.input(x), times), -1)) + core.position
    for index, block in enumerate(core.blocks):
        layer = core.prefix[index] if index < depth - 1 else core.prefix_end
        query, key, value = prefix_heads(layer, context)
        expert, own = block.attention, block.attention_norm(actions)
        if index % 2 == 0:
            own_query, own_key, own_value = heads(expert.query_key_value(own).chunk(3, -1))
            seen = torch.ones(STEPS, TOKENS + STEPS, dtype=bool).tril(TOKENS)
            mixed = attend(own_query, torch.cat((key, own_key), 2), torch.cat((value, own_value), 2), seen)
        else:
            (own_query,) = heads([expert.query(own)])
            (key_there,), (value_there,) = heads([expert.key(flat(key))]), heads([expert.value(flat(value))])
            mixed = attend(own_query, key_there, value_there, None)
        actions = actions + expert.output(flat(mixed))
        actions = actions + block.mlp(block.mlp_norm(actions))
        if layer is not core.prefix_end:
            seen = torch.ones(TOKENS, TOKENS, dtype=bool)
            seen[:-1, -1] = False
            context = context + layer.attention.output(flat(attend(query, key, value, seen)))
            context = context + layer.mlp(layer.mlp_norm(context))
    expected = core.output(core.norm(actions))
    torch.testing.assert_close(core(x, t, r, core.condition(inputs()[3])), expected)


def prefix_heads(layer, context):
    normed = layer.attention_norm(context)
    if hasattr(layer, "key_value"):
        return (None, *heads(layer.key_value(normed).chunk(2, -1)))
    return heads(layer.attention.query_key_value(normed).chunk(3, -1))


def heads(tensors):
    return tuple(x.unflatten(-1, (2, -1)).transpose(1, 2) for x in tensors)


def flat(x):
    return x.transpose(1, 2).flatten(2)


def attend(query, key, value, seen):
    """Queries are scaled in their weights already."""
    return nn.functional.scaled_dot_product_attention(query, key, value, attn_mask=seen, scale=1.0)


def test_an_action_does_not_depend_on_later_ones_but_on_earlier_ones():
    core = make_core()
    x, t, r, context = inputs()
    cached = core.condition(context)
    changed = x.clone()
    changed[:, 2] += 1
    differs = (core(changed, t, r, cached) != core(x, t, r, cached)).any(-1).any(0)
    assert differs.tolist() == [False, False, True, True, True]


def test_nothing_but_the_actions_sees_the_state():
    """The state comes last: its change reaches the prefix's keys and values at its own place alone."""
    core = make_core()
    *_, context = inputs()
    changed = context.clone()
    changed[:, -1] += 1
    for (keys, values), (others, other_values) in zip(
        core.condition(context).blocks, core.condition(changed).blocks, strict=True
    ):
        assert torch.equal(keys[..., :-1], others[..., :-1])
        assert not torch.equal(keys[..., -1], others[..., -1])
        assert torch.equal(values[..., :-1, :], other_values[..., :-1, :])


def test_jacobian_vector_product_equals_central_differences():
    core = make_core()
    x, t, r, context = inputs()
    cached = core.condition(context)
    direction = torch.randn(x.shape, generator=torch.Generator().manual_seed(2), dtype=x.dtype)
    step = 1e-5
    _, derivative = jvp(lambda x, t: core(x, t, r, cached), (x, t), (direction, torch.ones_like(t)))
    ahead, behind = (core(x + s * direction, t + s, r, cached) for s in (step, -step))
    difference = (ahead - behind) / (2 * step)
    assert (derivative - difference).norm() / difference.norm() < 1e-6
