"""Finds before the first stage what would fail later: options out of range, a policy that cannot learn."""

from collections.abc import Mapping
from typing import Any

import torch

from imfvla.config.construction import reason_of
from imfvla.config.protocol import EvaluationOptions
from imfvla.errors import UserError
from imfvla.options import part_of, require
from imfvla.policy import Policy, build_policy
from imfvla.policy.blank import blank_observation
from imfvla.robot_of import has_environment
from imfvla.rollouts.evaluation import require_device
from imfvla.rollouts.offline import refuse_rollout_options
from imfvla.storage.run_directory import step_of
from imfvla.training.experiment import ExperimentOptions, read_experiment
from imfvla.training.loop import choose_device
from imfvla.types import Batch


def checked_options(config: Mapping[str, Any]) -> ExperimentOptions:
    """The options of an experiment that can run here. Raises UserError on the first that is wrong."""
    options = read_experiment(config)
    training, evaluation = options.training, options.evaluation
    if not has_environment(config):
        part_of(config, "task.held_out")
        refuse_rollout_options(evaluation)
    paraphrases = part_of(config, "task.paraphrases")
    require(isinstance(paraphrases, bool), "task.paraphrases", "true or false", paraphrases)
    choose_device(training.device)
    require_device(evaluation.device, "evaluation.device")
    kept = training.checkpoint_steps()
    require(
        step_of(training.steps, evaluation.checkpoint) in kept,
        "evaluation.checkpoint",
        f"one of the weights that training.steps and training.checkpoints keep, those of the steps "
        f"{', '.join(map(str, sorted(kept)))}",
        evaluation.checkpoint,
    )
    return options


def rehearse(config: Mapping[str, Any], evaluation: EvaluationOptions) -> Policy:
    """The configured policy, after the losses of its first and last step and a chunk on black pictures.

    Raises UserError where it cannot be built, cannot compute them, or cannot be evaluated as is wanted.
    """
    nfe = evaluation.nfe
    try:
        policy = build_unfitted(config).eval()
        for number in nfe:
            policy.check_sampling(number, evaluation.noise_scale, evaluation.noise)
            policy.check_replanning(number, evaluation.candidates, evaluation.prefix)
        observation, noise = blank_observation(policy), torch.zeros(1, *policy.noise_shape)
        valid = torch.ones(1, policy.horizon.pred, dtype=torch.bool)
        with torch.no_grad():
            steps = config["training"]["steps"]
            losses = []
            for step in (0, steps - 1) if policy.has_stages else (0,):
                policy.begin_step(step, steps)
                rng = torch.Generator().manual_seed(0)
                losses.append(policy.loss(Batch(observation, noise, valid), rng)[0])
            chunk = policy.predict(observation, noise, min(nfe))
    except UserError:
        raise
    except Exception as error:  # unusable arguments that a constructor accepted can raise anything
        raise UserError(
            "the configured policy cannot compute a loss and a chunk: correct encoder, core or generator; torch says "
            f"{reason_of(error)!r}."
        ) from error
    is_finite = bool(torch.stack(losses).isfinite().all() and chunk.isfinite().all())
    found = [float(loss) for loss in losses]
    require(is_finite, "the first losses and chunk of encoder, core and generator", "finite", found)
    return policy


def build_unfitted(config: Mapping[str, Any]) -> Policy:
    """The policy of a composed config with normalisers that change nothing: it runs, but its outputs mean nothing."""
    policy = build_policy(config)
    states = torch.ones(len(policy.robot.state))
    policy.encoder.fit(-states, states)
    chunk = torch.zeros(policy.noise_shape)
    policy.chunks.normaliser.fit(chunk, chunk + 1, min_scale=1.0)
    return policy
