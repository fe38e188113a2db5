"""Makes the pictures of docs/pictures.

python tools/pictures.py                       # all that need only files of the repository
python tools/pictures.py rollouts socket       # some of them
python tools/pictures.py two_sentences --multitask runs/multitask/default     # after make train EXP=multitask
python tools/pictures.py toy --toy runs/toy                                   # after tools/toy.py --out runs/toy
"""

from imfvla.command import as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import io
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from PIL import Image

from imfvla.command.composition import compose
from imfvla.command.publication import publish
from imfvla.environment import Environment
from imfvla.environments.rollout import run_episode
from imfvla.episode import EpisodeInfo, EpisodeResult, Step
from imfvla.errors import UserError
from imfvla.figures.contact_sheet import contact_sheet, png
from imfvla.gallery import write_gallery
from imfvla.reporting.mapping import read_mapping
from imfvla.rollouts.actor import ChunkActor
from imfvla.rollouts.workbench import load_workbench
from imfvla.storage.files import write_together
from imfvla.storage.run_directory import RunDirectory
from imfvla.tasks.bimanual_robot import CONTROL_HZ, TIME_LIMIT_STEPS

ROOT = Path(__file__).resolve().parents[1]
RESULTS, SHIPPED = ROOT / "experiments" / "results", ROOT / "experiments" / "pretrained"
FIGURES = {  # picture -> figure of imfvla.report
    name: name for name in ("evaluations", "failures", "learning", "depth_attention")
} | {
    "reward_latency": "figure3_reward_latency",
    "success_by_cost": "success_by_cost_dwell",
    "success_by_cost_socket": "success_by_cost_socket_equal",
    "success_by_delay": "success_by_delay_table4",
    "success_by_severity": "success_by_severity_table5",
}
MOMENTS = 6  # of a rollout, start and end among them
STEPS = [round(share * TIME_LIMIT_STEPS) for share in np.linspace(0, 1, MOMENTS)]
TIMES = [f"{step / CONTROL_HZ:g} s" for step in STEPS]
SIZE = 216  # px of a picture in a rollout
ROLLOUTS = (  # median and worst as `evaluation.best_median_worst` finds them
    ("socket", 100_074, "the median of 100 episodes on the socket task"),
    ("transfer", 100_097, "the median of 100 episodes on the transfer task"),
    ("socket", 100_085, "one of the worst on the socket task"),
)
NFE, NOISE_SEED = 2, 0
SENTENCES = (10_090, 10_091)  # seeds of one start in the combined scene


class Snapshots:
    """A sink that keeps pictures of one view after certain steps."""

    def __init__(self, view: str = "front") -> None:
        self.view, self.pictures, self.instruction = view, [], ""

    def begin(self, env: Environment, info: EpisodeInfo) -> None:
        self.instruction = info.instruction
        self._show(env, 0)

    def step(self, env: Environment, step: Step) -> None:
        self._show(env, step.index + 1)

    def end(self, result: EpisodeResult) -> None:
        pass

    def abort(self) -> None:
        pass

    def _show(self, env: Environment, done: int) -> None:
        if done in STEPS:
            self.pictures.append(env.render(self.view, SIZE, SIZE))


@as_command
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    names = [*FIGURES, "rollouts", "socket"]
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(names)}, two_sentences, toy")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "pictures", help="where they go")
    parser.add_argument(
        "--multitask", type=Path, default=Path("runs/multitask/default"), help="a run of both tasks"
    )
    parser.add_argument("--toy", type=Path, default=Path("runs/toy"), help="what tools/toy.py has written")
    arguments = parser.parse_args()
    chosen = arguments.names or names
    unknown = [name for name in chosen if name not in (*names, "two_sentences", "toy")]
    if unknown:
        parser.error(
            f"unknown picture {', '.join(unknown)}; there are {', '.join(names)}, two_sentences, toy"
        )
    made = figures([name for name in chosen if name in FIGURES])
    if "rollouts" in chosen:
        made["rollouts"] = png(rollouts())
    if "socket" in chosen:
        made["socket"] = expert()
    if "two_sentences" in chosen:
        made["two_sentences"] = png(two_sentences(arguments.multitask))
    if "toy" in chosen:
        made["toy"] = shrunk(arguments.toy / "toy.png")
    write_together({arguments.out / f"{name}.png": content for name, content in made.items()})
    for name, content in made.items():
        print(f"{arguments.out / name}.png, {len(content) / 1000:.0f} kB")


def figures(names: list[str]) -> dict[str, bytes]:
    """Those that `make tables ARGS="directories=[experiments/results]"` makes."""
    if not names:
        return {}
    method = compose("train", ["+exp=socket_ph32_exec16"])
    with tempfile.TemporaryDirectory() as directory:
        files = publish([RESULTS], Path(directory), read_mapping(), method).files
        drawn: Mapping[str, bytes] = {path.name: content for path, content in files.items()}
        found = {}
        for name in names:
            path = Path(directory) / "figure.png"
            path.write_bytes(drawn[f"{FIGURES[name]}.png"])
            found[name] = shrunk(path)
    return found


def shrunk(path: Path) -> bytes:
    """The figure in a file with the 256 colours that differ most, so that none of a legend is lost.

    Raises UserError where there is none.
    """
    if not path.exists():
        raise UserError(f"{path} is missing: make it with python tools/toy.py --out {path.parent}.")
    stream = io.BytesIO()
    picture = Image.open(path).convert("RGB")
    picture.quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        stream, "png", optimize=True
    )
    return stream.getvalue()


def rollouts() -> np.ndarray:
    """Episodes of the shipped policies."""
    rows = []
    for task, seed, text in ROLLOUTS:
        played, result = _played(SHIPPED / f"{task}_ph32_exec16" / "generator=imf_plain", seed)
        outcome = "success" if result.success else "failure"
        rows.append((f"Start {seed}, {text}: {outcome}", played.pictures))
    return contact_sheet(rows, TIMES)


def two_sentences(run: Path) -> np.ndarray:
    """One start in the combined scene, with the sentence of each task."""
    rows = []
    for seed in SENTENCES:
        played, _ = _played(run, seed)
        rows.append((f'"{played.instruction}"', played.pictures))
    return contact_sheet(rows, TIMES)


def expert() -> bytes:
    """All views of an episode of the socket task's expert."""
    config = compose("gallery", ["task=socket"])
    with tempfile.TemporaryDirectory() as directory:
        first, *_ = write_gallery(config["task"], config["seed"], config["size"], Path(directory))
        return first.read_bytes()


def _played(run: Path, seed: int) -> tuple[Snapshots, EpisodeResult]:
    env, policy = load_workbench(run, RunDirectory(run).weights_step("last"))
    actor, shown = ChunkActor(policy, policy.horizon, NFE, NOISE_SEED), Snapshots()
    return shown, run_episode(env, actor, seed, [shown], kind="rollout", config={})


if __name__ == "__main__":
    sys.exit(main())
