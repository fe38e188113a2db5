"""Plays one episode of a trained policy and writes its Attention Residual weights, for the figures of make tables.

python tools/depth_attention.py experiments/pretrained/socket_ph32_exec16/generator=imf_plain

Writes depth_attention.json into the run directory: the mean weights of each sublayer over all tokens and decisions.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from pathlib import Path

from imfvla.rollouts.depth_attention import measure_depth_attention
from imfvla.rollouts.workbench import load_workbench
from imfvla.storage.files import write_json
from imfvla.storage.run_directory import RunDirectory

SELECTION_FIRST_SEED = 10_000
FILE = "depth_attention.json"


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a trained run")
    parser.add_argument("--checkpoint", default="last", help="training step of the weights, a share, or last")
    parser.add_argument("--seed", type=int, default=SELECTION_FIRST_SEED, help="seed of the start state")
    parser.add_argument("--nfe", type=int, default=1, help="calls of the network for a chunk (NFE)")
    parser.add_argument("--max-steps", type=int, default=None, help="control steps, all of them by default")
    arguments = parser.parse_args()
    directory = RunDirectory(arguments.run)
    checkpoint = int(arguments.checkpoint) if arguments.checkpoint.isdecimal() else arguments.checkpoint
    step = directory.weights_step(checkpoint)
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
