"""Figures 1 and 2 show what is configured: another configuration, another figure."""

from copy import deepcopy
from typing import Any

import pytest
import yaml
from seen import clipped, texts

from imfvla.command.composition import CONFIG_DIRECTORY, compose
from imfvla.figures.components import LEARNS, method_components
from imfvla.figures.description import GENERATOR, describe
from imfvla.figures.diagram import Sheet
from imfvla.figures.overview import method_overview
from imfvla.figures.style import render
from imfvla.policy import build_policy

FIGURES = [method_overview, method_components]


@pytest.fixture(scope="module")
def config() -> dict[str, Any]:
    return compose("train", ["+exp=socket_ph32_exec16"])


def changed(config: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    copy = deepcopy(config)
    *parents, last = key.split(".")
    node = copy
    for parent in parents:
        node = node[parent]
    node[last] = value
    return copy


def shown(figure) -> tuple:
    """Texts and shapes."""
    return texts(figure), [patch.get_path().vertices.round(3).tolist() for patch in figure.axes[0].patches]


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("observation.views", ["front"], "5 context tokens"),
        ("observation.image_size", [64, 64], "64 × 64 pixels"),
        ("horizon.obs", 2, "96 × 96 pixels, 2 steps"),
        ("encoder.view_tokens.tokens", 1, "6 context tokens"),
        ("core.depth", 6, "6 blocks, width 160, 5 heads"),
        ("core.width", 200, "4 blocks, width 200, 5 heads"),
        ("core.patch", 8, "4 action tokens, 8 actions each"),
        ("evaluation.nfe", [1, 4], "infer4"),
        ("horizon.pred", 16, "chunk of 16 actions at 50 Hz"),
        ("horizon.exec", 8, "the first 8 are executed, the rest is dropped; then it looks again"),
        ("horizon.exec", 32, "all 32 are executed; then it looks again"),
    ],
)
def test_the_overview_has_the_configured_numbers(config, key, value, text):
    before, after = texts(method_overview(config)), texts(method_overview(changed(config, key, value)))
    assert text in after
    assert text not in before


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("core.depth", 6), ("core.residual.readout", "attn"), ("generator.parametrisation", "velocity"),
        ("generator.boundary_share", 0.2), ("generator.times._target_", "imfvla.generators.base.BetaTimes"),
        ("evaluation.nfe", [1]),
    ],
)  # fmt: skip
def test_the_components_are_those_configured(config, key, value):
    assert shown(method_components(config)) != shown(method_components(changed(config, key, value)))


@pytest.mark.parametrize(
    ("overrides", "overview", "components"),
    [
        (["core=standard", "generator=ddpm"], "fixed residual sum", "Diffusion: what is learnt"),
        (
            ["core=block_attnres", "generator=meanflow"],
            "AttnRes over blocks of 4",
            "Mean Flow: what is learnt",
        ),
        (
            ["core/conditioning=adaln", "generator=flow"],
            "adaptive norms (DiT)",
            "Flow matching: what is learnt",
        ),
        (["generator=l2", "evaluation.nfe=[1]"], "L2 regression", "Regression: what is learnt"),
        (
            ["generator=two_step", "evaluation.nfe=[2]"],
            "two-step regression",
            "Two-step regression: what is learnt",
        ),
        (["generator=imf"], "Mean Flow in two stages", "Mean Flow in two stages: what is learnt"),
        (
            ["generator=imf", "generator.boundary_share=0.5", "generator.path_steps=1"],
            "1, 2 or 3 calls of the network",
            "over one Euler step along its own path",
        ),
        (
            ["generator=imf", "evaluation.nfe=[2,5]"],
            r"2 or 5 calls of $v_\theta$",
            "infer2, infer5: steps of $v$",
        ),
        (["generator=imf_plain"], "improved Mean Flow", "Improved Mean Flow: what is learnt"),
        (["generator=imle", "evaluation.nfe=[1]"], "one-step IMLE", "IMLE: what is learnt"),
        (
            ["encoder=resnet18_attnres", "scale=paper"],
            "12 blocks, width 384",
            "Attention Residuals: 12 blocks",
        ),
    ],
)
def test_other_methods_are_named_and_their_text_fits(overrides, overview, components):
    config = compose("train", ["+exp=transfer_ph32_exec16", *overrides])
    for draw, text in zip(FIGURES, (overview, components), strict=True):
        figure = draw(config)
        assert any(text in line for line in texts(figure))
        assert not clipped(figure)


def test_the_words_of_both_figures_are_of_generators_that_can_be_chosen():
    choices = [yaml.safe_load(path.read_text()) for path in (CONFIG_DIRECTORY / "generator").glob("*.yaml")]
    classes = {one["_target_"].rpartition(".")[2] for one in choices if "_target_" in one}
    assert set(LEARNS) < set(GENERATOR) <= classes


@pytest.mark.parametrize(
    ("cls", "name"),
    [("ConsistencyModel", "consistency model"), ("DDIMSampler", "DDIM sampler"), ("denoiser", "denoiser")],
)
def test_a_generator_without_words_of_its_own_is_shown_by_its_class(config, cls, name):
    other = changed(config, "generator", {"_target_": f"imfvla.generators.another.{cls}", "clip": 10.0})
    title = f"{name[0].upper()}{name[1:]}: what is learnt"
    for draw, text in zip(FIGURES, (name, title), strict=True):
        figure = draw(other)
        assert text in texts(figure)
        assert not clipped(figure)


def test_steps_that_follow_no_average_are_not_drawn_as_one(config):
    """At `boundary_share=1` one step is taken with u, and more with v."""
    assert config["generator"]["boundary_share"] == 1
    seen = texts(method_components(config))
    assert {"infer1", "infer2, infer3: steps of $v$"} <= set(seen)
    seen = texts(method_components(changed(config, "generator.boundary_share", 0.9)))
    assert {"infer1", "infer2", "infer3"} <= set(seen)


@pytest.mark.parametrize("conditioning", ["token", "adaln", "cross"])
def test_sublayers_are_counted_as_the_core_counts_them(conditioning):
    config = compose("train", ["+exp=socket_ph32_exec16", f"core/conditioning={conditioning}"])
    block = build_policy(config).core.block
    method = describe(config)
    assert len(method.sublayers) == block.num_sublayers
    assert method.num_sublayers == block.num_sublayers * config["core"]["depth"]
    shown = " ".join(texts(method_components(config)))
    assert f"4 blocks of {block.num_sublayers} sublayers, {4 * block.num_sublayers} in all" in shown
    assert ", ".join(method.sublayers) in texts(method_overview(config))


def test_tokens_are_counted_as_the_policy_counts_them(config):
    encoder = build_policy(config).encoder
    context = encoder.summary.in_features // config["core"]["width"] + 1
    method = describe(config)
    assert context == method.observed_steps * (len(method.views) * method.view_tokens + 1) + 2
    assert f"{context} context tokens" in texts(method_overview(config))


@pytest.mark.parametrize("draw", FIGURES)
def test_equal_figures_are_equal_files_with_all_text_on_the_sheet(config, draw):
    figure = draw(config)
    assert not clipped(figure)
    assert render(figure)[".svg"] == render(draw(config))[".svg"]


def test_text_that_would_be_unreadably_small_is_refused():
    with pytest.raises(ValueError, match="does not fit into 2 units"):
        Sheet(20, 10).text(5, 5, "a long sentence about nothing much", 2)
