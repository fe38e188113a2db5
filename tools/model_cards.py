"""Writes the model card (README.md) of every shipped policy again, from its files.

python tools/model_cards.py                     those in experiments/pretrained
python tools/model_cards.py mine/policies       those below another folder
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import sys
from pathlib import Path

from imfvla.reporting.model_card import NAME, model_card
from imfvla.storage.documents import read_json
from imfvla.storage.files import write_text
from imfvla.storage.run_directory import RunDirectory


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", default=Path("experiments/pretrained"))
    for made in sorted(parser.parse_args().folder.rglob("made_by.json")):
        place = made.parent
        command = read_json(made, "ship the policy again", mapping=True)["command"]
        write_text(place / NAME, model_card(RunDirectory(place), place, command))
        print(place / NAME)
    return 0


if __name__ == "__main__":
    sys.exit(main())
