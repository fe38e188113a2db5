"""Kills, stops and starves real processes of this project, lets them go on, and compares with an undisturbed run.

python tools/chaos.py                          # everything
python tools/chaos.py training --kills 50      # one kind of work

training, collection, evaluation   SIGKILL at random moments, every second one while a file is being written
stops                              Ctrl-C, SIGTERM and SIGUSR1 in the middle of training: seconds to the end, exit code
disk                               a full file system, a read-only one (both mounted, where that is allowed) and no
                                   file handles left
workers                            worker processes that die and hang in the middle of an evaluation

Processes are forked after everything is imported, so that the signals fall into the work. The policy is the tiny one
of the tests, and its environment stands in for the simulator; loop, checkpoints, recordings and logs are the real
ones. Prints a line for each fault and exits with 1 where anything differs.
"""

import argparse
import errno
import json
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from imfvla import collection, workbench
from imfvla.episode import Decision
from imfvla.errors import UserError
from imfvla.evaluation import evaluate
from imfvla.jobs import told
from imfvla.recording import read_episode
from imfvla.reporting.metrics import untimed
from imfvla.run_directory import RunDirectory
from imfvla.signals import Stopped, stoppable
from imfvla.training.checkpoint import read_tensors
from imfvla.training.logger import read_metrics
from imfvla.training.loop import Trainer

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "tests"), str(ROOT / "tests" / "training")]
from fakes import FakeEnvironment, build_fakes, known_actions  # noqa: E402
from tiny_policy import OPTIM, OPTIONS, CountedBatches, TinyPolicy  # noqa: E402

TIMES = {"steps_per_s", "data_wait_fraction", "train_s"}
POLL_S = 0.001
Work = Callable[[Path], None]


class Differs(Exception):
    """Something is not as it is after an undisturbed run."""


# --- the work -------------------------------------------------------------------------------------------------------


def train(folder: Path, steps: int, save_every_s: float = 0.0) -> None:
    """A whole training, by default with a state after every step."""
    options = replace(OPTIONS, steps=steps, log_every=1, checkpoints=4, save_every_s=save_every_s)
    Trainer(
        TinyPolicy(), CountedBatches(), RunDirectory(folder), options, OPTIM, seed=7, description={}
    ).train()


def roll_out(folder: Path, episodes: int) -> None:
    """An evaluation with its three recordings."""
    run = RunDirectory(folder)
    run.weights_directory(1).mkdir(parents=True, exist_ok=True)
    (run.weights_directory(1) / "policy.safetensors").write_bytes(b"read by nobody")
    observation = {"views": ["front"], "image_size": [16, 16]}
    config = {"name": "chaos", "task": {"name": "fake", "variant": "default"}, "observation": observation}
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    workbench._bench.cache_clear()
    evaluate(run, episodes=episodes, first_seed=100_000, nfe=[1], workers=0, build=build_fakes)


class Demonstrator:
    """Does what is known; its environment counts every fourth seed as a success."""

    def reset(self, env: Any, seed: int) -> None:
        self.actions = known_actions(40)

    def act(self, env: Any, state: np.ndarray, step: int) -> Decision:
        return Decision(self.actions[step], self.actions[step])


def collect(folder: Path, episodes: int) -> None:
    """Demonstrations, three of four of which fail."""
    env = FakeEnvironment()
    env.model_digest = lambda: "0" * 16
    env.paraphrases = ()
    collection._stage_for = lambda settings: (env, Demonstrator())
    task = {"name": "fake", "variant": "default", "expert": {"modes": 1, "noise": 0.0, "hold": 18}}
    demos = {"episodes": episodes, "first_seed": 0, "directory": str(folder), "camera_every": 2, "workers": 0}
    collection.collect(task, {"views": ["front", "top"], "image_size": [16, 16]}, demos)


# --- what must be equal -----------------------------------------------------------------------------------------------


def state_of(folder: Path) -> dict[str, Any]:
    """Everything that a training leaves, times apart."""
    run = RunDirectory(folder)
    files = {"state": run.last_state} | {f"step {s}": run.policy_weights(s) for s in run.weight_steps()}
    found: dict[str, Any] = {}
    for name, path in files.items():
        tensors, header = read_tensors(path)
        found |= {f"{name}: {key}": tensor for key, tensor in tensors.items()}
        details = json.loads(header.get("details", "{}"))
        found[f"{name}: header"] = {key: value for key, value in details.items() if key != "train_s"}
    rows = read_metrics(run.metrics)
    found["metrics"] = [{key: value for key, value in row.items() if key not in TIMES} for row in rows]
    return found


def rows_of(folder: Path) -> dict[str, Any]:
    """Everything that an evaluation leaves, times apart."""
    (rollouts,) = (folder / "rollouts").iterdir()
    rows = [json.loads(line) for line in (rollouts / "episodes.jsonl").read_text().splitlines()]
    actions = {path.name: torch.from_numpy(read_episode(path).executed) for path in rollouts.glob("*.mcap")}
    summary = json.loads((rollouts / "summary.json").read_text())
    same = ("success_episodes", "avg_return", "recordings", "protocol", "episodes", "failures")
    return {"rows": [untimed(row) for row in rows], "summary": [summary[key] for key in same], **actions}


def demonstrations_of(folder: Path) -> dict[str, Any]:
    """Everything that a collection leaves: content of recordings, seeds that failed, no other file."""
    found: dict[str, Any] = {}
    for path in sorted(file for file in folder.rglob("*") if file.is_file()):
        if path.suffix == ".mcap":
            episode = read_episode(path)
            found |= {
                f"{path.name} {key}": torch.from_numpy(getattr(episode, key)) for key in ("state", "action")
            }
            found |= {
                f"{path.name} {view}": torch.from_numpy(images) for view, images in episode.images.items()
            }
        elif path.suffix not in (".part", ".trial"):  # of a kill; begun anew when its seed is played
            found[path.name] = path.read_text()
    return found


def compare(found: dict[str, Any], wanted: dict[str, Any]) -> int:
    """The number of equal parts. Raises Differs naming those that are not equal bit for bit."""
    different = sorted(found.keys() ^ wanted.keys())
    for name in found.keys() & wanted.keys():
        one, other = found[name], wanted[name]
        equal = torch.equal(one, other) if isinstance(one, torch.Tensor) else one == other
        different += [] if equal else [name]
    if different:
        raise Differs(f"{len(different)} of {len(wanted)} parts differ: {', '.join(different[:6])}")
    return len(wanted)


# --- killing ----------------------------------------------------------------------------------------------------------


def start(work: Work, folder: Path) -> int:
    """The process that does `work`; what it says goes to `folder`.log."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        output = os.open(f"{folder}.log", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
        os.dup2(output, 1)
        os.dup2(output, 2)
        with stoppable():
            work(folder)
        code = 0
    except Stopped as stop:
        code = stop.exit_code
    except Exception as error:  # as the entry points tell it
        found = told(error)
        is_users = isinstance(found, UserError)
        print(found if is_users else repr(found), file=sys.stderr, flush=True)
        code = 2 if is_users else 1
    finally:
        os._exit(code)


def ended(child: int) -> int | None:
    """Its exit code, negative for a signal; None while it runs."""
    pid, status = os.waitpid(child, os.WNOHANG)
    return os.waitstatus_to_exitcode(status) if pid else None


def half_written(folder: Path) -> list[str]:
    """Files that are being written, or that a killed process was writing."""
    names = [path.name for path in folder.rglob("*") if path.suffix in (".tmp", ".part", ".trial")]
    cut = [path for path in folder.rglob("*.jsonl") if not path.read_bytes().endswith(b"\n")]
    return names + [path.name for path in cut if path.stat().st_size]


def progress_of(folder: Path) -> int:
    """Rows and recordings so far."""
    logs = [folder / "metrics.jsonl", *folder.glob("rollouts/*/*.jsonl")]
    total = len(list(folder.glob("*/*.mcap")))
    for path in logs:
        with suppress(FileNotFoundError):
            total += path.read_bytes().count(b"\n")
    return total


def kill_over(work: Work, folder: Path, kills: int, amount: int, rng: random.Random) -> tuple[int, int]:
    """Starts `work` until it ends by itself, killing it up to `kills` times, `amount` units of progress over all.

    Returns the kills, and how many of them fell into a write: a half-written file was there afterwards.
    """
    done = during_write = 0
    while True:
        child, began_at = start(work, folder), progress_of(folder)
        left = int(0.9 * amount) - began_at  # so that the last kill does not come after the end
        goal = began_at + rng.randint(0, max(0, 2 * left // max(1, kills - done) - 1))
        while (code := ended(child)) is None:
            if done < kills and progress_of(folder) >= goal:
                deadline = time.monotonic() + 2.0
                if done % 2:  # while a file is being written
                    while not half_written(folder) and ended_or_late(child, deadline):
                        pass
                else:
                    time.sleep(rng.random() * 0.02)
                with suppress(ProcessLookupError):
                    os.kill(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
                code = os.waitstatus_to_exitcode(status)
                break
            time.sleep(POLL_S)
        if code == -signal.SIGKILL:
            done += 1
            during_write += bool(half_written(folder))
        elif code == 0:
            return done, during_write
        else:
            raise Differs(f"exit code {code}: {Path(f'{folder}.log').read_text()[-500:]}")


def ended_or_late(child: int, deadline: float) -> bool:
    """Whether to go on waiting: the child runs and there is time."""
    info = os.waitid(os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT)
    return info is None and time.monotonic() < deadline


def undisturbed(work: Work, folder: Path) -> None:
    """Does it once, in a process like those that are killed."""
    _, status = os.waitpid(start(work, folder), 0)
    if code := os.waitstatus_to_exitcode(status):
        raise Differs(f"the undisturbed run ended with {code}: {Path(f'{folder}.log').read_text()[-500:]}")


def kills_of(work: Work, leaves: Callable[[Path], dict[str, Any]], amount: int) -> Callable[..., str]:
    """A fault: SIGKILL over one piece of work."""

    def inject(folder: Path, kills: int, rng: random.Random) -> str:
        undisturbed(work, folder / "whole")
        done, during_write = kill_over(work, folder / "killed", kills, amount, rng)
        equal = compare(leaves(folder / "killed"), leaves(folder / "whole"))
        if done < kills:
            raise Differs(f"ended after {done} of {kills} kills")
        return f"{done} kills, {during_write} of them into a write; {equal} parts equal bit for bit"

    return inject


# --- other faults -----------------------------------------------------------------------------------------------------


def stops(folder: Path, kills: int, rng: random.Random) -> str:
    """Signals that ask to stop: the state of the step is saved, the exit code says which it was."""
    work = partial(train, steps=120)
    rarely = partial(train, steps=120, save_every_s=1e9)
    undisturbed(work, folder / "whole")
    slowest, codes = 0.0, set()
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)
    for turn in range(max(3, kills // 5)):
        child = start(rarely, folder / "stopped")
        goal = progress_of(folder / "stopped") + rng.randint(1, 5)
        while progress_of(folder / "stopped") < goal and ended_or_late(child, time.monotonic() + 60):
            time.sleep(POLL_S)
        rows = len(read_metrics(folder / "stopped" / "metrics.jsonl"))
        began, number = time.monotonic(), numbers[turn % 3]
        os.kill(child, number)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        slowest = max(slowest, time.monotonic() - began)
        codes.add(code)
        if code != 128 + number:
            raise Differs(f"after {number.name} exit code {code}")
        _, header = read_tensors(RunDirectory(folder / "stopped").last_state)
        if json.loads(header["details"])["step"] < rows:
            raise Differs("steps before the stop were lost")
    undisturbed(work, folder / "stopped")
    equal = compare(state_of(folder / "stopped"), state_of(folder / "whole"))
    return f"{turn + 1} stops, exit codes {sorted(codes)}, at most {slowest:.1f} s; {equal} parts equal bit for bit"


def disk(folder: Path, kills: int, rng: random.Random) -> str:
    """A full disk, a read-only one, no file handles: an error that says so, the last state whole, then it goes on."""
    work = partial(train, steps=200)
    undisturbed(work, folder / "whole")
    mounted = folder / "small"
    mounted.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(mounted)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        raise Differs("no right to mount a small file system: run this in a container as root")
    said = {}
    try:
        target = mounted / "run"
        child = start(work, target)
        while progress_of(target) < 8 and ended_or_late(child, time.monotonic() + 60):
            time.sleep(POLL_S)
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        with suppress(OSError), open(mounted / "filler", "wb") as filler:
            while True:
                filler.write(b"\0" * 4096)
                filler.flush()
        said["full disk"] = fails(work, target, errno.ENOSPC)
        (mounted / "filler").unlink()
        subprocess.run(["mount", "-o", "remount,ro", str(mounted)], check=True)
        said["read-only"] = fails(work, target, errno.EROFS)
        subprocess.run(["mount", "-o", "remount,rw", str(mounted)], check=True)
        said["file handles"] = fails(partial(without_handles, work), target, errno.EMFILE)
        undisturbed(work, target)
        equal = compare(state_of(target), state_of(folder / "whole"))
    finally:
        subprocess.run(["umount", str(mounted)], check=False)
    for what, words in said.items():
        print(f"    {what}: {words}")
    return f"{len(said)} faults, exit code 2 each time; then {equal} parts equal bit for bit"


def without_handles(work: Work, folder: Path) -> None:
    """Leaves two handles: enough to open the logs, too few to save beside them."""
    highest = max(map(int, os.listdir("/proc/self/fd")))
    while os.dup(0) <= highest:  # fills the gaps
        pass
    resource.setrlimit(resource.RLIMIT_NOFILE, (highest + 4, highest + 4))
    work(folder)


def fails(work: Work, folder: Path, number: int) -> str:
    """What the user sees. Raises Differs where it is no clear error, the state is not whole or a half file is left."""
    log = folder.parent.parent / f"{errno.errorcode[number]}.log"  # on another file system
    link = Path(f"{folder}.log")
    with suppress(OSError):
        link.unlink(missing_ok=True)
        link.symlink_to(log)
    code = os.waitstatus_to_exitcode(os.waitpid(start_logging(work, folder, log), 0)[1])
    words = "".join(log.read_text().strip().splitlines()[-1:]) if log.exists() else ""
    if code != 2 or os.strerror(number) not in words:
        raise Differs(f"wanted exit code 2 and {os.strerror(number)!r}, found {code}: {words!r}")
    read_tensors(RunDirectory(folder).last_state)
    if left := half_written(folder):
        raise Differs(f"left behind: {left}")
    return words


def start_logging(work: Work, folder: Path, log: Path) -> int:
    """As `start`, with what it says in `log`."""

    def logged(_: Path) -> None:
        output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(output, 1)
        os.dup2(output, 2)
        os.close(output)
        work(folder)

    return start(logged, log.with_suffix(""))


def die_or_hang_once(run: Path, step: int) -> tuple[Any, Any]:
    """A `workbench.Build` whose first process dies and whose second one hangs, in the middle of an episode."""
    env, policy = build_fakes(run, step)
    played, reset = [], env.reset

    def faulty(seed: int) -> Any:
        played.append(seed)
        for name, fault in (
            ("died", lambda: os.kill(os.getpid(), signal.SIGKILL)),
            ("hung", lambda: time.sleep(3600)),
        ):
            if len(played) == 3 and not (run / name).exists():
                (run / name).touch()
                fault()
        return reset(seed)

    env.reset = faulty
    return env, policy


def workers(folder: Path, kills: int, rng: random.Random) -> str:
    """Workers that die and hang: their episodes are played again, and the summary says how many did."""
    roll_out(folder / "whole", 8)
    roll_out(folder / "faulty", 8)
    (rollouts,) = (folder / "faulty" / "rollouts").iterdir()
    subprocess.run(["rm", "-rf", str(rollouts)], check=True)
    options = {"episodes": 8, "first_seed": 100_000, "nfe": [1], "workers": 1, "episode_timeout_s": 60.0}
    (summary,) = evaluate(RunDirectory(folder / "faulty"), build=die_or_hang_once, **options)
    equal = compare(rows_of(folder / "faulty"), rows_of(folder / "whole"))
    if summary["worker_incidents"] != 2:
        raise Differs(f"worker_incidents is {summary['worker_incidents']}, wanted 2")
    return f"1 death, 1 hang: worker_incidents 2 in summary.json; {equal} parts equal bit for bit"


FAULTS: dict[str, Callable[[Path, int, random.Random], str]] = {
    "training": kills_of(partial(train, steps=150), state_of, 150),
    "collection": kills_of(partial(collect, episodes=40), demonstrations_of, 40),
    "evaluation": kills_of(partial(roll_out, episodes=150), rows_of, 150),
    "stops": stops,
    "disk": disk,
    "workers": workers,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("what", nargs="*", help=f"of {', '.join(FAULTS)}; all by default")
    parser.add_argument("--kills", type=int, default=50, help="over one training, collection, evaluation")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    options = parser.parse_args()
    if unknown := set(options.what) - FAULTS.keys():
        parser.error(f"no {', '.join(unknown)}; there are {', '.join(FAULTS)}")
    torch.set_num_threads(1)  # before the first fork: threads do not survive one
    with tempfile.TemporaryDirectory(prefix="imfvla-chaos-") as folder:
        train(Path(folder), steps=4)  # what is imported and looked up once is there in every process
    failed = 0
    for what in options.what or FAULTS:
        with tempfile.TemporaryDirectory(prefix="imfvla-chaos-") as folder:
            try:
                words = FAULTS[what](Path(folder), options.kills, random.Random(options.seed))
            except Differs as problem:
                failed, words = failed + 1, f"FAILED: {problem}"
        print(f"{what}: {words}", flush=True)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
