"""The campaign: trains and evaluates every policy of a sweep and keeps the results in experiments/results.

python tools/campaign.py                        conf/sweep/campaign.yaml, one policy after the other
python tools/campaign.py --side-by-side 2       two at a time, each with one thread and one worker
python tools/campaign.py --list                 the commands, and which of them are done
python tools/campaign.py --only transfer_dit    policies whose run directory has this name, or a name with this in it
python tools/campaign.py --commit               commits each result as soon as it is written

A policy is done when experiments/results has every evaluation that the sweep asks for, made with the same config. To
resume a campaign, rerun the command; on another machine, policies that were half trained start over. A policy that
fails does not stop the others. On Ctrl-C, running trainings save their state. Weights stay in runs/.
"""

from imfvla.command import EXIT_FAILURE, as_command, begin

if __name__ == "__main__":
    begin()

import argparse
import logging
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from threading import Lock

from imfvla.command.completion import is_reported
from imfvla.command.composition import register_resolvers
from imfvla.command.planning import Planned, planned_jobs
from imfvla.errors import UserError
from imfvla.process.progress import Progress
from imfvla.process.signals import Stopped
from imfvla.reporting.shipping import ship
from imfvla.storage.files import locked, put_folder
from imfvla.storage.run_directory import RunDirectory

RESULTS, LOGS = Path("experiments/results"), Path("runs/campaign")
ALONG_OTHERS = ("training.threads=1", "evaluation.workers=1")


@dataclass(frozen=True, slots=True)
class Policy:
    """One run directory, all jobs of the sweep that belong to it, and where its result is kept."""

    directory: Path
    jobs: tuple[Planned, ...]
    results: Path = RESULTS

    @property
    def name(self) -> str:
        return "/".join(self.directory.parts[-2:])

    @property
    def target(self) -> Path:
        return self.results / self.name

    @property
    def log(self) -> Path:
        """The log of its training, where several run side by side."""
        return LOGS / f"{self.name.replace('/', ',')}.log"

    @property
    def is_done(self) -> bool:
        return all(is_reported(job.config, self.target) for job in self.jobs)

    @property
    def commands(self) -> list[str]:
        return [f"python -m imfvla.train {' '.join(job.overrides)}" for job in self.jobs]


def policies(sweep: str, only: str = "", results: Path = RESULTS) -> list[Policy]:
    """The policy of conf/sweep/<sweep>.yaml called `only`, else those whose names contain it. UserError if none."""
    register_resolvers()
    jobs: dict[Path, list[Planned]] = {}
    for job in planned_jobs("train", [f"+sweep={sweep}"]):
        jobs.setdefault(job.directory, []).append(job)
    found = [Policy(directory, tuple(own), results) for directory, own in jobs.items()]
    chosen = [policy for policy in found if only == policy.name] or [
        policy for policy in found if only in policy.name
    ]
    if not chosen:
        names = ", ".join(policy.name for policy in found)
        raise UserError(f"--only {only} matches none of the policies of {sweep}: {names}.")
    return chosen


class Campaign:
    """Runs policies and keeps track of the processes that it has started."""

    def __init__(self, side_by_side: int, commit: bool) -> None:
        self._side_by_side, self._commit = side_by_side, commit
        self._running: set[subprocess.Popen] = set()
        self._git = Lock()
        self._is_stopped = False

    def run(self, waiting: Sequence[Policy], done: int = 0) -> list[str]:
        """Runs the policies that are not done yet and returns a sentence for each that failed."""
        failures: list[str] = []
        shown = self._side_by_side > 1  # a single training shows its own bars
        with (
            Progress("campaign", done + len(waiting), done=done, shown=shown) as bar,
            ThreadPoolExecutor(self._side_by_side) as pool,
        ):
            futures = {pool.submit(self._run_policy, policy): policy for policy in waiting}
            try:
                for future in as_completed(futures):
                    failure = future.result()
                    failures += [failure] if failure else []
                    bar.advance(futures[future].name)
            except Stopped as stop:
                self._stop(stop.number)
                raise
        return failures

    def _run_policy(self, policy: Policy) -> str | None:
        for command, job in zip(policy.commands, policy.jobs, strict=True):
            if self._is_stopped:
                return None
            code = self._train(policy, job.overrides)
            if code:
                log = policy.log if self._side_by_side > 1 else policy.directory / "train.log"
                return f"{command} ended with exit code {code}; see {log}."
        try:
            made_by = keep(policy)
        except UserError as error:
            return str(error)
        if self._commit:
            with self._git:
                commit(policy, made_by)
        return None

    def _train(self, policy: Policy, overrides: Sequence[str]) -> int:
        """The exit code of a training in a session of its own, so that Ctrl-C reaches it once, through `_stop`."""
        more = ALONG_OTHERS if self._side_by_side > 1 else ()
        arguments = [sys.executable, "-m", "imfvla.train", *overrides, *more]
        with ExitStack() as opened:
            output = None  # the terminal, where this is the only one
            if self._side_by_side > 1:
                policy.log.parent.mkdir(parents=True, exist_ok=True)
                output = opened.enter_context(open(policy.log, "a", encoding="utf-8"))
            process = subprocess.Popen(arguments, stdout=output, stderr=output, start_new_session=True)
            self._running.add(process)
            try:
                return process.wait()
            finally:
                self._running.discard(process)

    def _stop(self, number: int) -> None:
        self._is_stopped = True
        for process in [*self._running]:
            process.send_signal(number)


def keep(policy: Policy) -> dict[str, object]:
    """Replaces the policy's result by that of its run directory. UserError as `ship` raises it."""
    fresh = policy.target.with_name(f".{policy.target.name}.new")
    with locked(policy.target):  # another campaign may keep the same one
        shutil.rmtree(fresh, ignore_errors=True)
        made_by = ship(RunDirectory(policy.directory), fresh, with_weights=False)
        put_folder(fresh, policy.target)
    return made_by


def commit(policy: Policy, made_by: dict[str, object]) -> None:
    """Commits the policy's result and nothing else."""
    counts = {name: f"{r['success_episodes']} of {r['episodes']}" for name, r in made_by["results"].items()}
    body = "\n".join([str(made_by["command"]), "", *(f"{name}: {count}" for name, count in counts.items())])
    target = str(policy.target)
    subprocess.run(["git", "add", "--all", target], check=True)
    message = f"Add the result of {policy.name}\n\n{body}"
    subprocess.run(["git", "commit", "--quiet", "--message", message, "--", target], check=True)


@as_command
def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sweep", default="campaign", help="file of conf/sweep")
    parser.add_argument("--only", default="", help="a run directory's name, or part of several names")
    parser.add_argument("--side-by-side", type=int, default=1, choices=range(1, 65), metavar="N")
    parser.add_argument("--commit", action="store_true", help="commit each result")
    parser.add_argument("--list", action="store_true", help="run nothing")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    chosen = policies(arguments.sweep, arguments.only)
    if arguments.list:
        for policy in chosen:
            print("\n".join(f"{'done' if policy.is_done else 'open'}  {line}" for line in policy.commands))
        return 0
    waiting = [policy for policy in chosen if not policy.is_done]
    failures = Campaign(arguments.side_by_side, arguments.commit).run(waiting, len(chosen) - len(waiting))
    print("\n".join(failures), file=sys.stderr, end="\n" * bool(failures))
    return EXIT_FAILURE if failures else 0


if __name__ == "__main__":
    sys.exit(main())
