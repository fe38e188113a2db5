"""Silent changes of what a result rests on: each must be refused with its name, or must change no number."""

import json
import os
import random
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
import yaml
from fakes import build_fakes
from synthetic import write_demonstrations
from tiny_policy import OPTIM, OPTIONS
from torch import Tensor, nn

from faults.outcome import Differs
from faults.work import roll_out
from imfvla.config.horizon import Horizon
from imfvla.data import FrameStore, Loader, ResumableSampler, Windows, checksums
from imfvla.data.store_format import ARRAYS, IMAGES
from imfvla.errors import UserError
from imfvla.reporting.answers import refuse_copies
from imfvla.reporting.runs import evaluations
from imfvla.rollouts import workbench
from imfvla.rollouts.evaluation import evaluate
from imfvla.rollouts.rollout_log import PARTIAL
from imfvla.sources.mcap import McapSource
from imfvla.storage.code_changes import changes_since_commit
from imfvla.storage.run_directory import RunDirectory
from imfvla.training.loop import Trainer

VIEWS, SIZE, PRED = ("front", "top"), (16, 16), 4
Attack = Callable[[Path, random.Random], str]  # changes files below a folder, returns what an error must name


def changes(folder: Path, kills: int, rng: random.Random) -> str:
    """As many changes of the data of a training as there would be kills, and every change of an evaluation."""
    resumed = sum(_train_over(folder / f"data-{number}", rng) for number in range(max(kills, 1)))
    names = [_evaluate_over(folder / attack.__name__, attack, rng) for attack in OF_EVALUATION]
    _refuse_code(folder / "code")
    _refuse_copy(folder / "copies")
    return (
        f"{max(kills, 1)} changes of a training's data, {resumed} of them before it resumed, {len(names)} of an "
        "evaluation, new and changed code, a copied seed: all refused by name, or without effect"
    )


def flip(store: Path, rng: random.Random) -> str:
    """One bit of any array."""
    path = store / rng.choice(ARRAYS)
    content = bytearray(path.read_bytes())
    content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
    path.write_bytes(content)
    return path.name


def shift_actions(store: Path, rng: random.Random) -> str:
    path = store / "action.npy"
    np.save(
        path, np.load(path, allow_pickle=False) + np.float32(0.2 * rng.random() + 0.01), allow_pickle=False
    )
    return path.name


def black_picture(store: Path, rng: random.Random) -> str:
    path, size = store / IMAGES, 3 * SIZE[0] * SIZE[1]
    content = bytearray(path.read_bytes())
    first = size * rng.randrange(len(content) // size)
    content[first : first + size] = bytes(size)
    path.write_bytes(content)
    return path.name


def overwrite(store: Path, rng: random.Random) -> str:
    path = store / "action.npy"
    path.write_bytes(rng.randbytes(path.stat().st_size))
    return path.name


def truncate(store: Path, rng: random.Random) -> str:
    path = store / rng.choice(ARRAYS)
    os.truncate(path, rng.randrange(path.stat().st_size))
    return path.name


def other_sentence(store: Path, rng: random.Random) -> str:
    path = store / "meta.json"
    meta = json.loads(path.read_text(encoding="utf-8"))
    rng.choice(meta["episodes"])["instructions"] = ["drop it"]
    path.write_text(json.dumps(meta), encoding="utf-8")
    return path.name


def without_checksums(store: Path, rng: random.Random) -> str:
    """As an older version wrote it, with other actions: only the state of a training can tell."""
    path = store / "meta.json"
    meta = json.loads(path.read_text(encoding="utf-8"))
    del meta["checksums"]
    path.write_text(json.dumps(meta), encoding="utf-8")
    return shift_actions(store, rng)


def exchanged(store: Path, rng: random.Random) -> str:
    """Two recordings change places; the store is rebuilt from them."""
    one, other = rng.sample(sorted((store.parent / "demos").glob("*.mcap")), 2)
    content = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(content)
    return "demonstrations were exchanged"


OF_STORE = (flip, shift_actions, black_picture, overwrite, truncate, other_sentence)
OF_RESUMING = (without_checksums, exchanged)


class StatePolicy(nn.Module):
    """Regresses the actions of a chunk on the state."""

    def __init__(self, robot: object) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.net = nn.Linear(len(robot.state), PRED * len(robot.action))

    def spans(self, steps: int) -> dict[str, tuple[float, float]]:
        return {}

    def begin_step(self, step: int, steps: int) -> None:
        pass

    def loss(self, batch: object, rng: torch.Generator) -> tuple[Tensor, dict[str, Tensor]]:
        error = self.net(batch.obs.state[:, -1]).view_as(batch.actions) - batch.actions
        return (error.square().mean(-1) * batch.valid).mean(), {}


def _train(folder: Path, steps: int) -> None:
    """Trains to so many steps on the demonstrations in the folder, as a new process would."""
    checksums._seen.clear()
    source = McapSource.of(folder / "demos")
    store = FrameStore.build(source, folder / "store", SIZE, VIEWS)
    windows = Windows(store, Horizon(obs=1, pred=PRED, exec=2), source.robot)
    options = {**{name: getattr(OPTIONS, name) for name in OPTIONS.__slots__}, "steps": steps}
    Trainer(
        StatePolicy(source.robot),
        Loader(windows, ResumableSampler(len(windows), 8, 0)),
        RunDirectory(folder / "run"),
        type(OPTIONS)(**options),
        OPTIM,
        seed=7,
        description={},
    ).train()


def _train_over(folder: Path, rng: random.Random) -> bool:
    """Trains over changed data, from the beginning or from a saved state; returns whether it was to resume."""
    write_demonstrations(folder / "demos", num_steps=12)
    resumes = rng.random() < 0.7
    _train(folder, 2)
    if not resumes:
        shutil.rmtree(folder / "run")
    attack = rng.choice(OF_STORE + OF_RESUMING if resumes else OF_STORE)
    with _refused(attack.__name__) as expected:
        expected.append(attack(folder / "store", rng))
        _train(folder, 4)
    return resumes


@contextmanager
def _refused(what: str) -> Iterator[list[str]]:
    """Raises Differs unless its content ends with a UserError that has all of the words that are put into the list."""
    expected: list[str] = []
    try:
        yield expected
    except UserError as error:
        if missing := [words for words in expected if words not in str(error)]:
            raise Differs(f"{what}: the error lacks {missing}: {error}") from error
        return
    raise Differs(f"{what}: nothing was said")


def false_numbers(run: Path, rng: random.Random) -> str:
    """Every number of the summary: none may be used."""
    path = next(run.glob("rollouts/*/summary.json"))
    summary = json.loads(path.read_text(encoding="utf-8"))
    false = {key: 1234.5 for key, value in summary.items() if isinstance(value, float)}
    path.write_text(json.dumps(summary | false), encoding="utf-8")
    return ""


def false_rows(run: Path, rng: random.Random) -> str:
    path = next(run.glob("rollouts/*/episodes.jsonl"))
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    rng.choice(rows)["total_reward"] += 1.0
    path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    return "episodes.jsonl"


def false_description(run: Path, rng: random.Random) -> str:
    """A condition that was not played, another clock, another machine."""
    path = next(run.glob("rollouts/*/summary.json"))
    summary = json.loads(path.read_text(encoding="utf-8"))
    changed = rng.choice(
        [
            {"protocol": summary["protocol"] | {"condition": "bump", "severity": 1}},
            {"protocol": summary["protocol"] | {"clock": "running", "delay_ms": 20}},
            {"fingerprint": summary["fingerprint"] | {"machine": {"cpu": "a faster one"}}},
        ]
    )
    path.write_text(json.dumps(summary | changed), encoding="utf-8")
    return "was changed after it was written"


def no_rows(run: Path, rng: random.Random) -> str:
    next(run.glob("rollouts/*/episodes.jsonl")).unlink()
    return "episodes.jsonl is missing"


def other_config(run: Path, rng: random.Random) -> str:
    """Without what policy.json says, so that the digest of the evaluation must tell."""
    path = run / "config.yaml"
    config = yaml.safe_load(path.read_text(encoding="utf-8"))
    path.write_text(yaml.safe_dump(config | {"horizon": {"exec": rng.randint(1, 15)}}), encoding="utf-8")
    return "config.yaml is not what"


def config_of_other_weights(run: Path, rng: random.Random) -> str:
    config = yaml.safe_load((run / "config.yaml").read_text(encoding="utf-8"))
    for folder in run.glob("checkpoints/*"):
        trained = config | {"horizon": {"exec": 16}}
        (folder / "policy.json").write_text(json.dumps({"config": trained}), encoding="utf-8")
    (run / "config.yaml").write_text(yaml.safe_dump(config | {"horizon": {"exec": 4}}), encoding="utf-8")
    return "horizon.exec was 16, is 4"


def other_renderer(run: Path, rng: random.Random) -> str:
    """Half of the rows are left over, from another renderer, with returns of their own: none may stay."""
    (folder,) = (run / "rollouts").iterdir()
    rows = (folder / "episodes.jsonl").read_text(encoding="utf-8").splitlines()
    header = json.loads((run / "header.json").read_text(encoding="utf-8")) | {
        "gl_renderer": "another renderer"
    }
    left = [json.dumps(json.loads(row) | {"total_reward": 1234.5}) for row in rows[:4]]
    shutil.rmtree(folder)
    folder.mkdir()
    (folder / PARTIAL).write_text("\n".join([json.dumps(header), *left, ""]), encoding="utf-8")
    return ""


OF_EVALUATION: tuple[Attack, ...] = (
    false_numbers, false_rows, false_description, no_rows, other_config, config_of_other_weights, other_renderer,
)  # fmt: skip


def _evaluate_over(run: Path, attack: Attack, rng: random.Random) -> str:
    """Evaluates and reads again after an attack, which is refused where it names something."""
    with _headers_in(run):
        roll_out(run, 8)
    before = [found.episodes for found in evaluations(RunDirectory(run))]
    numbers = [found.summary["avg_return"] for found in evaluations(RunDirectory(run))]
    expected = attack(run, rng)
    if expected:
        for work in (lambda: roll_out_again(run), lambda: evaluations(RunDirectory(run))):
            with _refused(attack.__name__) as words:
                words.append(expected)
                work()
        return attack.__name__
    roll_out_again(run)
    after = evaluations(RunDirectory(run))
    found = [one.summary["avg_return"] for one in after]
    same = [[row["total_reward"] for row in rows] for rows in before]
    if found != numbers or [[row["total_reward"] for row in one.episodes] for one in after] != same:
        raise Differs(f"{attack.__name__}: {found} instead of {numbers}")
    return attack.__name__


def roll_out_again(run: Path) -> None:
    from imfvla.config.protocol import EvaluationOptions

    workbench._bench.cache_clear()
    options = EvaluationOptions(episodes=8, first_seed=100_000, nfe=(1,), workers=0, recordings=False)
    evaluate(RunDirectory(run), options, build=build_fakes)


@contextmanager
def _headers_in(run: Path) -> Iterator[None]:
    """Keeps the header of the partial file of an evaluation, which is gone when it has finished."""
    from imfvla.rollouts.rollout_log import RolloutLog

    begin = RolloutLog._open_partial

    def keep(self: RolloutLog, header: dict) -> None:
        (run / "header.json").write_text(json.dumps(header), encoding="utf-8")
        begin(self, header)

    RolloutLog._open_partial = keep
    try:
        yield
    finally:
        RolloutLog._open_partial = begin


def _refuse_code(root: Path) -> None:
    """A new file, a changed one and another change all count, and differ from each other."""
    root.mkdir(parents=True)
    identity = ["-c", "user.name=chaos", "-c", "user.email=chaos@localhost"]
    (root / "method.py").write_text("one = 1\n", encoding="utf-8")
    for arguments in (["init", "--quiet"], ["add", "."], [*identity, "commit", "--quiet", "-m", "begin"]):
        subprocess.run(["git", "-C", str(root), *arguments], check=True)
    found = [changes_since_commit(root)]
    for name, text in (("new.py", "two = 2\n"), ("new.py", "two = 3\n"), ("method.py", "one = 2\n")):
        (root / name).write_text(text, encoding="utf-8")
        found.append(changes_since_commit(root))
    if found[0] != "" or len({*found}) != len(found):
        raise Differs(f"changed code: {found}")


def _refuse_copy(folder: Path) -> None:
    roll_out(folder / "seed=0", 4)
    shutil.copytree(folder / "seed=0", folder / "seed=1")
    found = [one for seed in (0, 1) for one in evaluations(RunDirectory(folder / f"seed={seed}"))]
    with _refused("copied seed") as words:
        words.append("have the same weights")
        refuse_copies(found)
