"""A policy: normaliser, observation encoder, core and generator, put together from a configuration.

Shapes: B batch, Tp predicted steps, A action.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from imfvla.config.construction import construct, reason_of
from imfvla.config.horizon import Horizon
from imfvla.config.protocol import FRESH, GUIDED, NO_PREFIX, ROLLED, TRAINED, USUAL_NOISE, ZERO
from imfvla.config.views import view_options
from imfvla.data.statistics import Statistics
from imfvla.draws import Stream
from imfvla.errors import UserError
from imfvla.generators.base import Generator, HasStages, draws_noise, uses_noise
from imfvla.generators.inpainting import Inpaints, Target
from imfvla.policy.budget import SizeBudget
from imfvla.policy.chunks import ChunkFrame
from imfvla.policy.prefix import GivenContext, GivenCore, Known, PrefixInput, first_steps
from imfvla.robot import RobotSpec
from imfvla.robot_of import robot_of, with_robot
from imfvla.types import Batch, Observation


class Policy(nn.Module):
    """What the training loop and the evaluator know of any method: a loss and a prediction, in physical units."""

    def __init__(
        self,
        *,
        horizon: Horizon,
        robot: RobotSpec,
        views: Sequence[str],
        image_size: tuple[int, int],
        chunks: ChunkFrame,
        encoder: nn.Module,
        core: nn.Module,
        generator: Generator,
    ) -> None:
        super().__init__()
        self.horizon = horizon
        self.robot = robot
        self.views = tuple(views)  # cameras that it sees, in this order
        self.image_size = tuple(image_size)  # (H, W) [px] at which it sees them
        self.encoder = encoder
        self.core = core
        self.generator = generator
        self.chunks = chunks
        self.prefix: PrefixInput | None = None  # of policies that complete what is decided already

    @property
    def noise_shape(self) -> tuple[int, int]:
        """(Tp, A) of the noise that one prediction starts from."""
        return self.horizon.pred, len(self.robot.action)

    @property
    def has_stages(self) -> bool:
        """Whether what is learned depends on the step."""
        return isinstance(self.generator, HasStages)

    def spans(self, steps: int) -> dict[str, tuple[float, float]]:
        """Of parameters that do not learn in all of `steps` steps, the steps [first, end) in which they do, by name."""
        if not self.has_stages:
            return {}
        return {name: self.generator.span(name, steps) for name, _ in self.named_parameters()}

    def begin_step(self, step: int, steps: int) -> None:
        """Is told of step `step` (0-based) of `steps` before its loss, for generators whose training has stages."""
        if self.has_stages:
            self.generator.begin_step(self.core, step, steps)

    def targets(self, batch: Batch) -> Tensor:
        """The normalised chunks (B, Tp, A) that the generator learns, held behind an episode's end."""
        return self.chunks.normalise(hold_last(batch.actions, batch.valid), batch.obs.state[:, -1])

    def loss(self, batch: Batch, rng: Stream) -> tuple[Tensor, dict[str, Tensor]]:
        """The mean loss over the batch, a scalar, and scalars to log. Steps that are not valid do not count."""
        actions, valid, tokens = self.targets(batch), batch.valid, self.encoder(batch.obs)
        if self.prefix is None:
            core, context = self.core, self.core.condition(tokens)
        else:
            counts = self.prefix.draw(len(actions), rng).to(actions.device)
            given = first_steps(counts, actions.shape[1])
            core, context = self._given(tokens, actions, given)
            valid = valid & ~given
        loss, logs = self.generator.loss(core, context, actions, valid, rng)
        return loss.mean(), logs

    def context(self, obs: Observation) -> Any:
        """What the core makes of observations when no action is given."""
        return self._free(self.encoder(obs))

    def _free(self, tokens: Tensor) -> Any:
        if self.prefix is not None:
            actions = tokens.new_zeros(len(tokens), *self.noise_shape)
            tokens = self.prefix(tokens, actions, actions[..., 0] > 0)
        return self.core.condition(tokens)

    def _given(self, tokens: Tensor, actions: Tensor, given: Tensor) -> tuple[Any, Any]:
        """Core and context for tokens (B, L, D) where some of the actions (B, Tp, A) are `given` (B, Tp)."""
        context = self.core.condition(self.prefix(tokens, actions, given))
        if self.core.interface == "style":  # has no noisy input
            return self.core, context
        return GivenCore(self.core), GivenContext(context, actions, given.unsqueeze(-1))

    def check_sampling(self, nfe: int, noise_scale: float, noise: str = FRESH) -> None:
        """Raises UserError where the generator cannot sample in `nfe` evaluations from noise of this scale and kind."""
        self.generator.check_nfe(nfe)
        if noise in (ZERO, ROLLED) and draws_noise(self.generator, nfe):
            raise UserError(
                f"noise must be {FRESH} or held with nfe={nfe}, found {noise}: with so many evaluations "
                f"{type(self.generator).__name__} draws noise in later steps too, from the first one as a whole. Take "
                "another noise or another nfe."
            )
        if noise_scale != USUAL_NOISE and draws_noise(self.generator, nfe):
            raise UserError(
                f"noise_scale must be {USUAL_NOISE:g} with nfe={nfe}, found {noise_scale:g}: with so many evaluations "
                f"{type(self.generator).__name__} draws noise in later steps too, which the scale does not reach. Take "
                "noise_scale=1 or another nfe."
            )

    def check_replanning(self, nfe: int, candidates: int, prefix: str) -> None:
        """Raises UserError where so many candidates are all the same, or where chunks cannot begin as `prefix` says.

        `EvaluationOptions` has both options.
        """
        name = type(self.generator).__name__
        if candidates > 1 and not uses_noise(self.generator):
            raise UserError(
                f"candidates must be 1 with {name}, found {candidates}: its chunk does not depend on the "
                "noise, so that all samples are equal."
            )
        if prefix == TRAINED and self.prefix is None:
            raise UserError(
                f"prefix={TRAINED} needs a policy that was trained with horizon.prefix_max above 0, found 0: train "
                f"one, or set prefix={NO_PREFIX}, or prefix={GUIDED} for a sampler of several steps."
            )
        if prefix == GUIDED and (nfe == 1 or not isinstance(self.generator, Inpaints)):
            raise UserError(
                f"prefix={GUIDED} corrects a sample between its steps, and {name} with nfe={nfe} has none: take more "
                f"steps of a flow, Mean Flow or diffusion; or train with horizon.prefix_max and set prefix={TRAINED}."
            )

    def predict(self, obs: Observation, noise: Tensor, nfe: int, known: Known | None = None) -> Tensor:
        """Action chunks (K B, Tp, A) in physical units from noise (K B, Tp, A) and `nfe` calls of the core.

        Each observation is encoded once and serves K rows of noise that lie side by side. The chunks begin with the
        decided actions of `known`.
        """
        tokens, state = self.encoder(obs), obs.state[:, -1]
        draws = len(noise) // len(state)
        if draws > 1:
            tokens, state = tokens.repeat_interleave(draws, 0), state.repeat_interleave(draws, 0)
        if known is None:
            chunk = self.generator.sample(self.core, self._free(tokens), noise, nfe)
            return self.chunks.denormalise(chunk, state)
        actions = self.chunks.normalise(known.actions.unsqueeze(0), state)
        if known.weights is not None:
            target = Target(actions, known.weights)
            chunk = self.generator.inpaint(self.core, self._free(tokens), noise, nfe, target)
        else:
            counts = torch.full((len(noise),), known.decided, device=noise.device)
            core, context = self._given(tokens, actions, first_steps(counts, noise.shape[1]))
            chunk = self.generator.sample(core, context, noise, nfe)
        chunk = self.chunks.denormalise(chunk, state)
        chunk[:, : known.decided] = known.actions[: known.decided]
        return chunk


def hold_last(actions: Tensor, valid: Tensor) -> Tensor:
    """Actions (B, Tp, A) in which steps that are not `valid` (B, Tp) repeat the last valid action before them.

    They have no error of their own, but a network sees them among its noisy inputs, and a derivative passes through
    them. What a policy does behind an episode's end is to stay where it is; zeros would be the mean of all chunks.
    """
    steps = torch.arange(valid.shape[1], device=valid.device)
    last = torch.where(valid, steps, 0).cummax(dim=1).values
    return actions.gather(1, last.unsqueeze(-1).expand_as(actions))


def build_policy(config: Mapping[str, Any], statistics: Statistics | None = None) -> Policy:
    """The policy that a composed configuration describes, with the normalisers fitted where `statistics` are given.

    Encoder and core are handed what robot and observation decide: the numbers of views, states and actions, and where
    the state is among the context tokens.
    Without statistics the normalisers are not-a-number until a checkpoint fills them. Raises UserError where the
    parts do not fit together.
    """
    try:
        config = with_robot(config)
        horizon, robot, seen = Horizon(**config["horizon"]), robot_of(config), view_options(config)
        chunks = ChunkFrame(config["action_frame"], horizon.pred, robot)
        with SizeBudget():
            encoder = construct(
                config["encoder"], "encoder", views=len(seen.views), state_dim=len(robot.state)
            )
            policy = Policy(
                horizon=horizon,
                robot=robot,
                views=seen.views,
                image_size=seen.image_size,
                chunks=chunks,
                encoder=encoder,
                core=construct(
                    config["core"], "core", channels=len(robot.action), state_token=encoder.state_token
                ),
                generator=construct(config["generator"], "generator", Generator),
            )
            if horizon.prefix_max:
                policy.prefix = PrefixInput(horizon.prefix_max, len(robot.action), policy.core.width)
    except KeyError as error:
        raise UserError(
            f"the configuration lacks the key {error.args[0]!r} that a policy is built from."
        ) from None
    except UserError:
        raise
    except Exception as error:  # parts that a constructor took can be unusable together
        raise UserError(f"the configured policy cannot be built: {reason_of(error)}") from error
    wanted, found = policy.generator.core_interface, policy.core.interface
    if wanted != found:
        raise UserError(
            f"generator {config['generator']['_target_']} drives cores of the kind {wanted!r}, core "
            f"{config['core']['_target_']} is of the kind {found!r}: core=act goes with generator=act, "
            f"core.velocity_head=true with generator=imf or generator=imf_plain generator.v_from=head, "
            "any other core with any other generator."
        )
    if policy.encoder.last_token != policy.core.last_token:
        raise UserError(
            f"encoder {config['encoder']['_target_']} ends its context with the {policy.encoder.last_token}, core "
            f"{config['core']['_target_']} wants the {policy.core.last_token} there: core=smolvla goes with "
            f"encoder=smolvla/cpu or smolvla/paper, any other core with any other encoder."
        )
    if statistics is not None:
        policy.encoder.fit(torch.as_tensor(statistics.state_min), torch.as_tensor(statistics.state_max))
        policy.chunks.fit(statistics)
    return policy
