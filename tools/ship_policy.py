"""Copies what is needed to evaluate a finished run elsewhere, and how it was made, into a small directory.

python tools/ship_policy.py runs/socket_act/default experiments/pretrained/socket_act/default
python tools/ship_policy.py --without-weights runs/socket_act/default experiments/results/socket_act/default

Taken are the config, the last averaged weights, the metrics of every 10th logged step and the episodes and summaries
of the reporting band; made_by.json has the command, commit, seed and results. Optimiser state, recordings and
curves stay behind, and with --without-weights, for a result that the tables are made from, the weights too.
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import json
import sys
from pathlib import Path

from imfvla.reporting.shipping import ship
from imfvla.storage.run_directory import RunDirectory


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("target", type=Path, help="new directory")
    parser.add_argument("--without-weights", action="store_true", help="results alone")
    arguments = parser.parse_args()
    run = RunDirectory(arguments.run)
    made_by = ship(run, arguments.target, with_weights=not arguments.without_weights)
    print(json.dumps(made_by["results"], indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
