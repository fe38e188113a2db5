"""The time that a policy needs for a chunk on this machine, taken alone, before an evaluation starts its workers.

Rollouts that run side by side report the latency of a loaded machine. This one is kept in `latency.json` of the run, so
that an evaluation that resumes has the same delay, and with its time and the machine's load, so that readers can judge
it.
"""

import os
from collections.abc import Callable
from datetime import UTC, datetime

import numpy as np

from imfvla.config.protocol import EAGER, NO_PREFIX, Protocol
from imfvla.environment import Environment
from imfvla.reporting.records import MOST_LATENCIES, Latencies, Latency
from imfvla.rollouts.actor import ChunkActor
from imfvla.storage.files import write_json
from imfvla.storage.fingerprint import machine
from imfvla.storage.records import read_record
from imfvla.storage.run_directory import RunDirectory

FILE = "latency.json"
OF = (
    "weights",
    "nfe",
    "candidates",
    "prefix",
    "device",
    "runtime",
)  # keys of a protocol that times depend on
OLDER = {"prefix": NO_PREFIX, "runtime": EAGER}  # in files that are older than the keys
REMEDY = "delete it; the times are then taken again"
CALLS, FEWEST_CALLS, WARM_UP = (
    200,
    20,
    20,
)  # of one evaluation of the network; a sampler with n has an n-th of them


def latency_of(
    run: RunDirectory, protocol: Protocol, measure: Callable[[], Latency], *, again: bool = False
) -> Latency:
    """The time of a chunk of these weights with this NFE, candidates and prefix, on this device, runtime and machine.

    It is the kept one, or that of `measure`.

    `again` measures in any case. Raises UserError where the file is damaged.
    """
    path = run.path / FILE
    kept = read_record(path, Latencies, REMEDY, home=run.path) if path.exists() else []
    of = {key: getattr(protocol, key) for key in OF} | {"machine": machine()}
    others = [found for found in kept if any({**OLDER, **found}.get(key) != of[key] for key in of)]
    if len(others) < len(kept) and not again:
        return next(found for found in kept if found not in others)
    found = {**of, **measure()}
    write_json(path, [*others, found][-MOST_LATENCIES:])
    return found


def measure_latency(
    env: Environment, actor: ChunkActor, num_observed: int, views: tuple[str, ...], nfe: int
) -> Latency:
    """Median and p95 of a chunk from `num_observed` looks at the start of seed 0, with when and under which load."""
    load, at = os.getloadavg()[0], datetime.now(UTC).isoformat(timespec="seconds")
    env.reset(seed=0)
    actor.reset(env, 0)
    seen = env.look()
    images, states = [[seen[view] for view in views]] * num_observed, [env.state()] * num_observed
    calls, warm_up = max(FEWEST_CALLS, CALLS // nfe), max(1, WARM_UP // nfe)
    actor.remember(
        0, actor.plan(images, states, 0)[0]
    )  # as the last one, which prefix and candidates look at
    times = [actor.plan(images, states, 1, 1)[1] for _ in range(warm_up + calls)][warm_up:]
    return {
        "median_ms": round(float(np.median(times)), 3),
        "p95_ms": round(float(np.percentile(times, 95)), 3),
        "calls": calls,
        "at": at,
        "load": round(load, 2),
    }
