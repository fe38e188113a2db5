"""Trains the configured generators on eight Gaussians and judges their samples; exits with 1 where one is not right.

python tools/toy.py --out runs/toy

Generators are those of conf/generator as they are. iMF, plain and in stages, in one evaluation and flow matching and
DDPM in 100 must pass; flow matching in one evaluation and iMF with the sign of its derivative flipped must fail the
same test.
Writes toy.json, toy.svg and toy.png.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import logging
import sys
from pathlib import Path

import torch

from imfvla.benchmarks.toy import GENERATORS, draw, run_cases
from imfvla.figures.style import render
from imfvla.figures.toy import toy_figure
from imfvla.process.progress import Progress
from imfvla.storage.files import write_json, write_together
from imfvla.storage.fingerprint import fingerprint

SHOWN = 3000  # samples in a panel


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("runs/toy"), help="where the results go")
    parser.add_argument("--steps", type=int, default=10_000, help="of each training")
    parser.add_argument("--samples", type=int, default=10_000, help="that are judged")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    torch.set_num_threads(1)
    with Progress("eight Gaussians", len(GENERATORS) * arguments.steps) as bar:
        cases = run_cases(
            steps=arguments.steps, samples=arguments.samples, seed=arguments.seed, advance=bar.advance
        )
    for case in cases:
        quality = case.quality
        verdict = "as it must" if case.is_as_expected else "NOT as it must"
        print(
            f"{case.generator + f', {case.nfe} evaluations':38} energy distance {quality.energy_distance:.4f}  "
            f"modes {quality.modes} of 8  near {quality.near:.3f}  {verdict} {'pass' if case.must_pass else 'fail'}"
        )
    settings = {name: getattr(arguments, name) for name in ("steps", "samples", "seed")}
    rows = [case.row() for case in cases]
    write_json(arguments.out / "toy.json", {**settings, "cases": rows, "fingerprint": fingerprint(threads=1)})
    data = draw(SHOWN, torch.Generator().manual_seed(arguments.seed + 3)).numpy()
    panels = [
        (
            f"{case.generator}, NFE {case.nfe}",
            f"energy distance {case.quality.energy_distance:.4f}\n"
            f"{case.quality.modes} of 8 modes, {100 * case.quality.near:.0f}% near one",
            case.quality.passes,
            case.samples[:SHOWN].numpy(),
        )
        for case in cases
    ]
    pictures = render(toy_figure(data, panels))
    write_together({arguments.out / f"toy{suffix}": content for suffix, content in pictures.items()})
    return 0 if all(case.is_as_expected for case in cases) else 1


if __name__ == "__main__":
    sys.exit(main())
