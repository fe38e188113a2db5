"""Plays one episode of a trained policy and writes its Attention Residual weights, for the figures of make tables.

python tools/depth_attention.py RUN                     plays an episode, writes RUN/depth_attention.json
python tools/depth_attention.py RUN --uniform FOLDER    plays nothing, writes the policy with uniform weights

The file has the mean weights of each sublayer over all tokens and decisions. A policy whose queries are zero reads all
increments alike, which after the pre-norm is a fixed residual: evaluate it to see what the learned weights do.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from pathlib import Path

from imfvla.rollouts.depth_attention import attention_residuals, measure_depth_attention
from imfvla.rollouts.workbench import load_workbench
from imfvla.storage.documents import read_json
from imfvla.storage.files import refuse_existing, write_json
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy, save_weights

SELECTION_FIRST_SEED = 10_000
FILE = "depth_attention.json"


def write_uniform(run: RunDirectory, step: int, target: RunDirectory) -> Path:
    """A run directory with the weights of `run` after `step`, but with queries of zero. Returns its path.

    Raises UserError where the path is taken, or the core has no Attention Residuals.
    """
    refuse_existing(target.path, "choose a new folder")
    policy = load_policy(run, step)
    for residual in attention_residuals(policy.core):
        residual.query.zero_()
    target.claim(run.config())
    description = read_json(run.policy_weights(step).with_suffix(".json"), "restore it", mapping=True)
    save_weights(target.weights_directory(step), policy, description)
    return target.path


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a trained run")
    parser.add_argument("--checkpoint", default="last", help="training step of the weights, a share, or last")
    parser.add_argument("--seed", type=int, default=SELECTION_FIRST_SEED, help="seed of the start state")
    parser.add_argument("--nfe", type=int, default=1, help="calls of the network for a chunk (NFE)")
    parser.add_argument("--max-steps", type=int, default=None, help="control steps, all of them by default")
    parser.add_argument(
        "--uniform", type=Path, metavar="FOLDER", help="run directory to write: queries are zero"
    )
    arguments = parser.parse_args()
    directory = RunDirectory(arguments.run)
    checkpoint = int(arguments.checkpoint) if arguments.checkpoint.isdecimal() else arguments.checkpoint
    step = directory.weights_step(checkpoint)
    if arguments.uniform:
        print(write_uniform(directory, step, RunDirectory(arguments.uniform)))
        return 0
    env, policy = load_workbench(arguments.run, step)
    found = measure_depth_attention(
        env, policy, seed=arguments.seed, nfe=arguments.nfe, max_steps=arguments.max_steps
    )
    found = {"experiment": directory.config()["name"], "checkpoint_step": step, **found}
    write_json(arguments.run / FILE, found)
    print(arguments.run / FILE)
    return 0


if __name__ == "__main__":
    sys.exit(main())
