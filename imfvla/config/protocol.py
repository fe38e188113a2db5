"""The options of an evaluation, and what its rows depend on besides the code. Needs neither torch nor mujoco."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from typing import Annotated, Any

from imfvla.config.condition import NONE, UNCHANGED, ConditionOptions
from imfvla.options import DIFFERENT, Limit, above, at_least, one_of, require, some, within

USUAL_NOISE = 1.0
FRESH, HELD, ROLLED, ZERO = NOISES = "fresh", "held", "rolled", "zero"
MOST_CANDIDATES = 64
MOST_BATCH = 256
PAUSED, RUNNING = CLOCKS = "paused", "running"
HOLD, CONTINUE = MEANWHILE = "hold", "continue"
NO_PREFIX, GUIDED, TRAINED = PREFIXES = "none", "guided", "trained"
MEASURED = "measured"
EAGER, ONNX = RUNTIMES = "eager", "onnx"
MOST_DELAY_MS = 10_000
# Start states: below the first are those of demonstrations, from there on those that choices are made on; those of
# tables are for reporting alone. More demonstrations than the first band has go on behind all of these.
SELECTION_FIRST_SEED, REPORTING_FIRST_SEED = 10_000, 100_000
DEMONSTRATION_SEEDS = range(SELECTION_FIRST_SEED), range(1_000_000, 10_000_000)
REPORTING_SEEDS = range(REPORTING_FIRST_SEED, DEMONSTRATION_SEEDS[1].start)
LAST = "last"  # of the weights that are kept
MAX_SEED = 2**32 - 1  # the highest that numpy's generators and MuJoCo's start states accept
MAX_EPISODES = 50_000  # of an evaluation: more could not be read back, see `storage.documents.MAX_PARTS`
MAX_WORKERS = 1024
MAX_TIMEOUT_S = 7 * 24 * 3600


def _is_checkpoint(value: int | str) -> bool:
    if value == LAST or re.fullmatch(r"[1-9]\d*", str(value)):
        return True
    return bool(re.fullmatch(r"[1-9]\d*/[1-9]\d*", str(value))) and Fraction(value) <= 1


CHECKPOINT = Limit(
    "last, a training step of at least 1, or a share of the training such as 1/3", _is_checkpoint
)
DELAY = Limit(
    f"measured, or a number of ms between 0 and {MOST_DELAY_MS}",
    lambda value: value == MEASURED or (not isinstance(value, str) and 0 <= value <= MOST_DELAY_MS),
)


@dataclass(frozen=True, slots=True)
class EvaluationOptions:
    """What a user chooses for an evaluation: conf/evaluate.yaml, or the `evaluation` of an experiment.

    Attributes:
      checkpoint: the training step of the weights, a share of the training such as "1/3", or "last".
      noise_seed: of the noise streams; use the same for policies to be compared.
      noise_scale: of the noise that a chunk starts from; below 1 samples are closer to each other.
      noise: what becomes of it from one replanning to the next, see `rollouts.noise`.
      candidates: samples of a replanning, of which the one nearest to the last chunk is executed.
      clock: "paused", where the world waits while the policy computes, or "running".
      delay_ms: on a running clock, the time from a look to its chunk; "measured" takes this policy's own.
      meanwhile: what the robot does until then: "hold" its last target, or "continue" with its present chunk.
      prefix: what makes a late chunk begin as the present one goes on: "guided", where a sampler of several steps is
        corrected towards it, "trained", in a policy with `horizon.prefix_max`, or "none".
      condition: how the world differs from the one that was trained in.
      device: where the policy computes.
      runtime: what computes it: "eager", torch, or "onnx", ONNX Runtime with the run's exported graphs.
      batch: episodes that a worker plays side by side, computing their chunks as one batch; 1 as in the tables.
      workers: processes with one thread each; 0 works in this process; None takes the physical cores.
      episode_timeout_s: an episode that takes longer is replayed in a fresh worker; None: no limit.
      max_steps: control steps of an episode, None for all.
      recordings: whether the best, the median and the worst episode are recorded.
      overwrite: whether a finished evaluation is repeated.
    """

    episodes: Annotated[int, within(1, MAX_EPISODES)]
    first_seed: Annotated[int, within(0, MAX_SEED)]
    nfe: Annotated[tuple[int, ...], some(at_least(1)), DIFFERENT]
    checkpoint: Annotated[int | str, CHECKPOINT] = LAST
    noise_seed: Annotated[int, within(0, MAX_SEED)] = 0
    noise_scale: Annotated[float, within(0, 1)] = USUAL_NOISE
    noise: Annotated[str, one_of(*NOISES)] = FRESH
    candidates: Annotated[int, within(1, MOST_CANDIDATES)] = 1
    clock: Annotated[str, one_of(*CLOCKS)] = PAUSED
    delay_ms: Annotated[int | float | str, DELAY] = MEASURED
    meanwhile: Annotated[str, one_of(*MEANWHILE)] = HOLD
    prefix: Annotated[str, one_of(*PREFIXES)] = NO_PREFIX
    condition: ConditionOptions = UNCHANGED
    device: Annotated[str, one_of("cpu", "cuda")] = "cpu"
    runtime: Annotated[str, one_of(*RUNTIMES)] = EAGER
    batch: Annotated[int, within(1, MOST_BATCH)] = 1
    workers: Annotated[int, within(0, MAX_WORKERS)] | None = None
    episode_timeout_s: (
        Annotated[float, above(0), Limit("at most a week", lambda s: s <= MAX_TIMEOUT_S)] | None
    ) = None
    max_steps: Annotated[int, at_least(1)] | None = None
    recordings: bool = True
    overwrite: bool = False

    def __post_init__(self) -> None:
        last = self.first_seed + self.episodes - 1
        require(last <= MAX_SEED, "the last seed, first_seed + episodes - 1,", f"at most {MAX_SEED}", last)
        one_noise = self.candidates > 1 and (self.noise != FRESH or self.noise_scale == 0)
        wanted = "1 unless noise is fresh and noise_scale above 0: equal noise gives equal samples"
        require(not one_noise, "candidates", wanted, self.candidates)
        for key, only in (("candidates", 1), ("device", "cpu"), ("prefix", NO_PREFIX)):
            value = getattr(self, key)
            fits = self.runtime == EAGER or value == only
            wanted = f"{only} with runtime=onnx, whose graphs take one observation on the CPU and no decided actions"
            require(fits, key, wanted, value)
        for key, only in (("runtime", EAGER), ("prefix", NO_PREFIX)):
            value = getattr(self, key)
            fits = self.batch == 1 or value == only
            wanted = (
                f"{only} with batch={self.batch}: graphs and chunks with a prefix are computed one by one"
            )
            require(fits, key, wanted, value)
        for key, usual in (("delay_ms", MEASURED), ("meanwhile", HOLD)):
            value = getattr(self, key)
            needless = self.clock == PAUSED and value != usual
            require(not needless, key, f"{usual} with clock=paused: set clock=running for another", value)
        aimless = self.meanwhile != CONTINUE and self.prefix != NO_PREFIX
        wanted = f"{NO_PREFIX} unless the robot goes on meanwhile: set clock=running meanwhile={CONTINUE} for another"
        require(not aimless, "prefix", wanted, self.prefix)

    @property
    def is_running(self) -> bool:
        """Whether the world runs on while the policy computes."""
        return self.clock == RUNNING

    @property
    def is_measured(self) -> bool:
        """Whether the delay is the time that this policy needs here."""
        return self.is_running and self.delay_ms == MEASURED

    def in_protocol(self) -> dict[str, Any]:
        """What these options decide of a `Protocol`, by its keys."""
        return {
            "noise_seed": self.noise_seed,
            "noise_scale": self.noise_scale,
            "first_seed": self.first_seed,
            "episodes": self.episodes,
            "max_steps": self.max_steps,
            "device": self.device,
            "runtime": self.runtime,
            "batch": self.batch,
            "noise": self.noise,
            "candidates": self.candidates,
            "clock": self.clock,
            "delay_ms": self.delay_ms if self.is_running else 0,
            "meanwhile": self.meanwhile,
            "prefix": self.prefix,
            "condition": self.condition.name,
            "severity": self.condition.severity,
        }


@dataclass(frozen=True, slots=True)
class Protocol:
    """Equal protocols give equal rows except for times."""

    task: str
    variant: str
    checkpoint_step: int
    weights: str  # first 16 hex digits of the SHA-256 of the weights
    nfe: int
    noise_seed: int
    noise_scale: float  # of the noise that a chunk starts from; 1 is what policies are trained with
    first_seed: int
    episodes: int
    max_steps: int | None  # control steps of an episode, None for all of them
    device: str  # "cpu" or "cuda", where the policy computes
    noise: str = FRESH  # from one replanning to the next
    candidates: int = 1
    clock: str = PAUSED
    delay_ms: float | str = (
        0  # that was asked for; "measured": this policy's own on the machine of the summary
    )
    delay_steps: int = 0  # the same in control steps, rounded up
    meanwhile: str = HOLD
    prefix: str = NO_PREFIX
    condition: str = NONE
    severity: int | None = None
    runtime: str = EAGER  # what computes the policy
    batch: int = 1  # chunks of so many episodes are computed together

    @property
    def tells_jumps(self) -> bool:
        """Whether rows have the distance between consecutive chunks; those of the tables keep their bytes."""
        return (self.noise, self.candidates, self.clock) != (FRESH, 1, PAUSED)

    def place(self, seed: int) -> int:
        """Of the episode from `seed` in its batch."""
        return (seed - self.first_seed) % self.batch

    @property
    def seeds(self) -> range:
        return range(self.first_seed, self.first_seed + self.episodes)

    def name(self, last_step: int) -> str:
        """The folder in `rollouts/`: seeds and nfe, and what is unusual where the weights of `last_step` are usual."""
        unusual = {
            f"_step{self.checkpoint_step}": self.checkpoint_step != last_step,
            f"_noise{self.noise_seed}": self.noise_seed != 0,
            f"_scale{self.noise_scale:g}": self.noise_scale != USUAL_NOISE,
            f"_{self.noise}": self.noise != FRESH,
            f"_best{self.candidates}": self.candidates != 1,
            f"_max{self.max_steps}": self.max_steps is not None,
            f"_{self.device}": self.device != "cpu",
            f"_{self.runtime}": self.runtime != EAGER,
            f"_batch{self.batch}": self.batch != 1,
            f"_delay{_shown(self.delay_ms)}-{self.meanwhile}": self.clock != PAUSED,
            f"-{self.prefix}": self.prefix != NO_PREFIX,
            f"_{self.condition}{self.severity}": self.condition != NONE,
        }
        suffixes = "".join(text for text, applies in unusual.items() if applies)
        return f"seeds{self.seeds[0]}-{self.seeds[-1]}_nfe{self.nfe}{suffixes}"


def demonstration_seeds(first_seed: int) -> Iterator[int]:
    """The seeds of demonstrations from `first_seed` on, ascending over both bands."""
    bands = (range(max(first_seed, band.start), band.stop) for band in DEMONSTRATION_SEEDS)
    return chain.from_iterable(bands)


# What a protocol has where its evaluation is as in the tables, and where it is older than the key.
USUAL = {
    "noise_scale": USUAL_NOISE,
    "noise": FRESH,
    "candidates": 1,
    "clock": PAUSED,
    "delay_ms": 0,
    "delay_steps": 0,
    "meanwhile": HOLD,
    "prefix": NO_PREFIX,
    "condition": NONE,
    "severity": None,
    "runtime": EAGER,
    "batch": 1,
}


def as_recorded(protocol: Mapping[str, Any]) -> dict[str, Any]:
    """The "protocol" of a summary, which may have been written before one of `USUAL` was known."""
    return {**USUAL, **protocol}


def unusual(protocol: Mapping[str, Any]) -> tuple[str, ...]:
    """What distinguishes a protocol from those of the tables, in words; nothing where all is usual."""
    said = []
    if protocol["noise_scale"] != USUAL_NOISE:
        said.append(f"noise {protocol['noise_scale']:g}")
    if protocol["noise"] != FRESH:
        said.append(f"{protocol['noise']} noise")
    if protocol["candidates"] != 1:
        said.append(f"best of {protocol['candidates']}")
    if protocol["clock"] != PAUSED:
        steps, source = protocol["delay_steps"], protocol["delay_ms"]
        delay = "measured delay" if source == MEASURED else f"delay {source:g} ms"
        counted = "" if steps is None else f" ({steps} {'step' if steps == 1 else 'steps'})"
        said.append(f"{delay}{counted}, {protocol['meanwhile']}")
    if protocol["prefix"] != NO_PREFIX:
        said.append(f"{protocol['prefix']} prefix")
    if protocol["condition"] != NONE:
        said.append(f"{protocol['condition']} {protocol['severity']}")
    if protocol["runtime"] != EAGER:
        said.append("ONNX Runtime")
    if protocol["batch"] != 1:
        said.append(f"batch {protocol['batch']}")
    return tuple(said)


def _shown(delay: float | str) -> str:
    return delay if isinstance(delay, str) else f"{delay:g}"
