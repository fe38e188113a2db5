"""From episodes to the paper's nine metrics, with the interval of the success count."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from imfvla.episode import EpisodeResult
from imfvla.reporting.records import Row

TIMING = "timing"  # key of a row that holds all that differs between equal runs


def row_of(result: EpisodeResult) -> Row:
    """The line of `episodes.jsonl`: plain values; times are under the last key, inference times rounded to 1 us."""
    return {
        "seed": result.seed,
        "start_digest": result.start_digest,
        "num_steps": result.num_steps,
        "total_reward": float(result.total_reward),
        "max_reward": float(result.max_reward),
        "success": bool(result.success),
        "first_step_of_stage": list(result.first_step_of_stage),
        "failure": result.failure,
        **({"goal": result.goal} if result.goal else {}),
        TIMING: {
            "wall_s": round(result.wall_s, 6),
            "inference_ms": [round(value, 3) for value in result.inference_ms],
        },
    }


def untimed(row: Row) -> dict[str, Any]:
    """The row without its times: equal for equal runs."""
    return {key: value for key, value in row.items() if key != TIMING}


def summarise(rows: Sequence[Row]) -> dict[str, Any]:
    """The metrics of paper section 4.1 over at least one episode, and the interval of the success share.

    Times are in ms, rates in 1/s; they are None where no inference was timed. `control_fps` is control
    steps per second of wall time in the episodes, rendering included; `inference_fps` is 1000 /
    `inference_ms_mean`.
    """
    returns = np.array([row["total_reward"] for row in rows])
    inference_ms = np.array([value for row in rows for value in row[TIMING]["inference_ms"]])
    wall_s = sum(row[TIMING]["wall_s"] for row in rows)
    successes = sum(bool(row["success"]) for row in rows)
    timed = inference_ms.size > 0
    return {
        "episodes": len(rows),
        "avg_return": float(returns.mean()),
        "median_return": float(np.median(returns)),
        "mean_max_reward": float(np.mean([row["max_reward"] for row in rows])),
        "max_return": float(returns.max()),
        "nonzero_episodes": int((returns > 0).sum()),
        "success_episodes": successes,
        "inference_fps": float(1000 / inference_ms.mean()) if timed else None,
        "control_fps": sum(row["num_steps"] for row in rows) / wall_s if wall_s > 0 else None,
        "inference_ms_mean": float(inference_ms.mean()) if timed else None,
        "inference_ms_median": float(np.median(inference_ms)) if timed else None,
        "inference_ms_p95": float(np.percentile(inference_ms, 95)) if timed else None,
        "success_interval": list(wilson_interval(successes, len(rows))),
        **({"success_of_goal": success_of_goal(rows)} if "goal" in rows[0] else {}),
        "failures": dict(sorted(Counter(row["failure"] for row in rows if row["failure"]).items())),
    }


def success_of_goal(rows: Sequence[Row]) -> dict[str, list[int]]:
    """[successes, episodes] by the task asked for, where one scene serves several tasks."""
    counts: dict[str, list[int]] = {}
    for row in rows:
        count = counts.setdefault(row["goal"], [0, 0])
        count[0] += bool(row["success"])
        count[1] += 1
    return dict(sorted(counts.items()))


def wilson_interval(successes: int, trials: int, z: float = 1.959964) -> tuple[float, float]:
    """Wilson's score interval of a share (default 95%), within [0, 1] (E. B. Wilson, JASA 22, 1927)."""
    if not 0 <= successes <= trials or trials < 1:
        raise ValueError(f"Wanted 0 <= successes <= trials and trials >= 1, found {successes} of {trials}.")
    share = successes / trials
    centre = share + z**2 / (2 * trials)
    spread = z * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    scale = 1 + z**2 / trials
    low = 0.0 if successes == 0 else (centre - spread) / scale
    high = 1.0 if successes == trials else (centre + spread) / scale
    return low, high
