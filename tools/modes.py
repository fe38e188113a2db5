"""Draws samples of a trained policy at recorded observations and says what they are, beside the demonstrations.

python tools/modes.py experiments/pretrained/transfer_ph32_exec16/generator=imf_plain --nfe 1 2 3

Without --demos the expert plays 30 starts of the band for choosing, into outputs/modes. Prints one table: when grippers
close and in which order, samples between modes, dependence on the noise, jumps between consecutive chunks.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import logging
import sys
from pathlib import Path

import torch

from imfvla.config.protocol import SELECTION_FIRST_SEED
from imfvla.errors import UserError
from imfvla.figures.modes import modes_figure
from imfvla.figures.style import render
from imfvla.modes.grippers import grippers_of
from imfvla.modes.observations import Stops
from imfvla.modes.recordings import (
    choose_recordings,
    read_demonstration,
    record_starts,
    settings_of,
)
from imfvla.modes.report import measure, modes_table
from imfvla.process.progress import Progress
from imfvla.storage.files import write_json, write_together
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.checkpoint import load_policy


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a trained run")
    parser.add_argument("--nfe", type=int, nargs="+", default=[1], help="network steps per chunk")
    parser.add_argument("--checkpoint", default="last", help="training step of the weights, a share, or last")
    parser.add_argument("--demos", type=Path, help="folder of demonstrations; those trained on are left out")
    parser.add_argument(
        "--first-seed", type=int, help=f"of the demonstrations; {SELECTION_FIRST_SEED} of the expert's"
    )
    parser.add_argument("--episodes", type=int, default=30, help="demonstrations that are looked at")
    parser.add_argument("--observations", type=int, default=200, help="of each kind, at most")
    parser.add_argument("--samples", type=int, default=16, help="at each observation")
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--out", type=Path, default=Path("outputs/modes"), help="of recordings and the figure"
    )
    parser.add_argument("--json", type=Path, help="file for all numbers")
    arguments = parser.parse_args()
    for name, least in (("episodes", 1), ("observations", 1), ("samples", 2)):
        if getattr(arguments, name) < least:
            raise UserError(f"--{name} must be at least {least}, found {getattr(arguments, name)}.")
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    directory = RunDirectory(arguments.run)
    config, checkpoint = directory.config(), arguments.checkpoint
    settings = settings_of(config)
    step = directory.weights_step(int(checkpoint) if checkpoint.isdecimal() else checkpoint)
    policy = load_policy(directory, step).to(arguments.device)
    for nfe in arguments.nfe:
        policy.generator.check_nfe(nfe)
    first_seed, episodes = arguments.first_seed, arguments.episodes
    if arguments.demos is None:
        first_seed = SELECTION_FIRST_SEED if first_seed is None else first_seed
        paths = record_starts(config, arguments.out, first_seed, episodes)
    else:
        paths = choose_recordings(config, arguments.demos, first_seed, episodes)
    grippers = grippers_of(policy.robot)
    stops = Stops(policy.horizon, settings.views, grippers, len(paths), arguments.observations)
    for path in paths:
        stops.add(read_demonstration(path, settings))
    stops.finish()
    with Progress("samples", len(arguments.nfe)) as bar:
        measured = measure(policy, stops, arguments.nfe, arguments.samples, settings.modes, bar.advance)
    name, variant = config["name"], arguments.run.resolve().name
    title = name if variant in (name, "default") else f"{name} {variant}"
    what = f"{arguments.samples} samples at each observation of {len(paths)} demonstrations"
    modes_table(measured, f"{title}, step {step}: {what}").print()
    pictures = render(modes_figure(measured, f"{title}, step {step}"))
    arguments.out.mkdir(parents=True, exist_ok=True)
    figure = arguments.out / title.replace(" ", "_")
    write_together({figure.with_name(figure.name + suffix): data for suffix, data in pictures.items()})
    print(f"\n{figure}.svg and .png")
    if arguments.json is not None:
        seeds = sorted({place.seed for place in stops.starts.places})
        run = {"experiment": config["name"], "checkpoint_step": step, "demonstrations": str(paths[0].parent)}
        write_json(arguments.json, {**run, "seeds": seeds, **measured})
    return 0


if __name__ == "__main__":
    sys.exit(main())
