"""The method of a composed training config, in the words and numbers of the figures."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from imfvla.environments import BIMANUAL
from imfvla.robot import bare_name, unit_of
from imfvla.robot_of import has_environment, robot_of, with_robot

VISION = {"CompactCNN": "compact CNN", "CompactResNet": "compact ResNet", "ResNet18": "ResNet18"}
CORE = {
    "TransformerCore": "one token sequence",
    "CrossAttentionCore": "cross-attention to the context",
    "AdaptiveNormCore": "adaptive norms (DiT)",
}
# of a block, in the order in which they run (the `num_sublayers` of the core's block)
SUBLAYERS = {"CrossAttentionCore": ("attention", "cross-attention", "MLP")}
TWO_SUBLAYERS = ("attention", "MLP")
# A generator that is not listed is shown by the name of its class: "ConsistencyModel" as "consistency model".
GENERATOR = {
    "ImprovedMeanFlow": "improved Mean Flow",
    "MeanFlow": "Mean Flow",
    "StagedMeanFlow": "Mean Flow in two stages",
    "FlowMatching": "flow matching",
    "DenoisingDiffusion": "diffusion (DDPM)",
    "Regression": "L{power} regression",
    "TwoStepRegression": "two-step regression",
    "ImplicitMaximumLikelihood": "one-step IMLE",
    "ActionChunking": "ACT",
}
TIMES = {
    "HighNoiseTimes": "high-noise-biased times",
    "UniformTimes": "uniform times",
    "LogitNormalTimes": "logit-normal times",
    "BetaTimes": "beta times",
}
WORLD = {BIMANUAL: "MuJoCo simulation"}
STANDARD, ATTENTION, BLOCK = "standard", "attention", "block"
RESIDUAL = {"StandardResidual": STANDARD, "AttentionResidual": ATTENTION, "BlockAttentionResidual": BLOCK}


@dataclass(frozen=True, slots=True)
class Method:
    """Sizes are None where a core or an encoder has none of that name."""

    task: str
    views: tuple[str, ...]
    image_size: tuple[int, int]
    observed_steps: int
    state_dim: int
    state: str  # what its channels are, in a word or two
    control_hz: float
    world: str  # what plays the episodes
    vision: str
    vision_residual: str  # STANDARD or ATTENTION
    view_tokens: int | None  # of each view
    core: str
    sublayers: tuple[str, ...]  # of each block
    depth: int
    width: int
    heads: int
    patch: int
    residual: str  # one of RESIDUAL's values
    block_size: int
    readout: str  # sum | attn
    generator_class: str
    generator: str
    parametrisation: str | None
    times: str | None
    boundary_share: float | None
    average_from: float | None  # of two stages: the share of the training before the second one
    path_steps: int | None  # of the second stage
    prediction: str | None  # of diffusion
    num_levels: int | None
    nfe: tuple[int, ...]
    pred: int
    exec: int

    @property
    def num_action_tokens(self) -> int:
        return -(-self.pred // self.patch)

    @property
    def num_sublayers(self) -> int:
        return len(self.sublayers) * self.depth

    @property
    def is_improved_mean_flow(self) -> bool:
        return self.generator_class == "ImprovedMeanFlow"

    @property
    def is_staged(self) -> bool:
        """Whether the average velocity is learned after the instantaneous one."""
        return self.generator_class == "StagedMeanFlow"

    @property
    def instant_nfe(self) -> tuple[int, ...]:
        """Those of `nfe` whose steps follow the instantaneous velocity although an average is learned."""
        if not self.is_staged or self.boundary_share is None or self.boundary_share < 1:
            return ()
        return tuple(nfe for nfe in self.nfe if nfe > 1)


def describe(config: Mapping[str, Any]) -> Method:
    """The method of a config that `conf/train.yaml` composed."""
    config = with_robot(config)
    robot = robot_of(config)
    encoder, core, generator = config["encoder"], config["core"], config["generator"]
    residual = core.get("residual", {})
    times = generator.get("times")
    return Method(
        task=config["task"]["name"],
        views=tuple(config["observation"]["views"]),
        image_size=tuple(config["observation"]["image_size"]),
        observed_steps=config["horizon"]["obs"],
        state_dim=len(robot.state),
        state="joints and grippers" if all(map(_is_joint, robot.state)) else "state",
        control_hz=robot.control_hz,
        world=WORLD.get(config["task"].get("kind", BIMANUAL), "environment")
        if has_environment(config)
        else "recorded episodes",
        vision=_name(encoder.get("vision", encoder), VISION),
        vision_residual=encoder.get("vision", {}).get("residual", STANDARD),
        view_tokens=encoder.get("view_tokens", {}).get("tokens"),
        core=_name(core, CORE),
        sublayers=sublayers_of(core),
        depth=core["depth"],
        width=core["width"],
        heads=core["heads"],
        patch=core.get("patch", 1),
        residual=_name(residual, RESIDUAL) if residual else STANDARD,
        block_size=residual.get("block_size", 1),
        readout=residual.get("readout", "sum"),
        generator_class=class_of(generator),
        generator=generator_name(class_of(generator), generator.get("power")),
        parametrisation=generator.get("parametrisation"),
        times=_name(times, TIMES) if times else None,
        boundary_share=generator.get("boundary_share"),
        average_from=generator.get("average_from"),
        path_steps=generator.get("path_steps"),
        prediction=generator.get("prediction"),
        num_levels=generator.get("num_levels"),
        nfe=tuple(config["evaluation"]["nfe"]),
        pred=config["horizon"]["pred"],
        exec=config["horizon"]["exec"],
    )


def sublayers_of(core: Mapping[str, Any]) -> tuple[str, ...]:
    """What a block of a configured core is made of."""
    return SUBLAYERS.get(class_of(core), TWO_SUBLAYERS)


def generator_name(cls: str, power: object = None) -> str:
    """A generator's class in words: those of GENERATOR, else the words that its name is made of.

    `power` is that of a regression's errors, 1 where nothing is said.
    """
    if cls in GENERATOR:
        return GENERATOR[cls].format(power=1 if power is None else power)
    words = re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+", cls)
    return " ".join(word if word.isupper() else word.lower() for word in words) or cls


def listing(numbers: Sequence[int]) -> str:
    """As in "1, 2 or 3"."""
    if len(numbers) == 1:
        return str(numbers[0])
    return f"{', '.join(map(str, numbers[:-1]))} or {numbers[-1]}"


def _is_joint(channel: str) -> bool:
    return unit_of(channel) == "rad" or bare_name(channel).rpartition("/")[2] == "gripper"


def class_of(part: Mapping[str, Any]) -> str:
    """The name of the class that a part of a config is built from."""
    return str(part.get("_target_", "")).rpartition(".")[2]


def _name(part: Mapping[str, Any], names: Mapping[str, str]) -> str:
    return names.get(class_of(part), class_of(part))
