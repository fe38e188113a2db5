"""The metrics: what a policy's episodes say of it. Tables, page, CSV files and summary.json loop over `METRICS`.

All are computed from `episodes.jsonl`, so that a new one is there for evaluations that are older than it.
"""

from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from imfvla.reporting.records import Row
from imfvla.reporting.rows import TIMING
from imfvla.reporting.statistics import estimates
from imfvla.reporting.statistics.estimates import wilson_interval
from imfvla.reporting.statistics.measured import Measured

Episodes = Sequence[Row]


@dataclass(frozen=True, slots=True)
class Metric:
    """A number of a policy, and how tables show it.

    Attributes:
      name: in summary.json, in `Result.metrics`, and as `of` in experiments/tables.yaml.
      column: of the CSV files; with an interval also that name with _low and _high.
      of: the number, from at least one episode; None where it was not measured.
      title: of the column in tables for people; None for the CSV files alone.
      digits: decimals in tables for people.
      data_digits: decimals in the CSV files.
      estimate: the number with its interval, from the episodes of each training seed; None for no interval.
      share: of a count of episodes, the metric that has its share, whose interval is shown beside the count.
      printed: the field of a `PaperRow` that has it.
      printed_digits: decimals of what the paper prints.
    """

    name: str
    column: str
    of: Callable[[Episodes], float | None]
    title: str | None = None
    digits: int = 2
    data_digits: int = 4
    estimate: Callable[[Sequence[Episodes]], Measured] | None = None
    share: str | None = None
    printed: str | None = None
    printed_digits: int = 2

    def measured(self, by_seed: Sequence[Episodes]) -> Measured:
        """The number, with its interval if it has one, from the episodes of each training seed."""
        if self.estimate is not None:
            return self.estimate(by_seed)
        return Measured(self.of([row for episodes in by_seed for row in episodes]))


def column(key: str, kind: type = float) -> Callable[[Episodes], np.ndarray]:
    """The values of a key of the rows: a number for each episode."""
    return lambda episodes: np.array([row[key] for row in episodes], kind)


rewards, highest_rewards, successes = column("total_reward"), column("max_reward"), column("success", bool)


def rewarded(episodes: Episodes) -> np.ndarray:
    return rewards(episodes) > 0


def inference_times(episodes: Episodes) -> np.ndarray:
    """Of every replanning [ms]."""
    times = array("d")
    for row in episodes:
        times.extend(row[TIMING]["inference_ms"])
    return np.array(times)


def inference_time_sums(episodes: Episodes) -> np.ndarray:
    """Of each episode [ms]."""
    return np.array([sum(row[TIMING]["inference_ms"]) for row in episodes], float)


def inference_counts(episodes: Episodes) -> np.ndarray:
    return np.array([len(row[TIMING]["inference_ms"]) for row in episodes], int)


def chunk_jumps(episodes: Episodes) -> np.ndarray:
    """Mean distance between consecutive chunks in the episodes that have it, as a share of the actions' ranges."""
    return np.array([row["chunk_jump"] for row in episodes if "chunk_jump" in row], float)


def plain(statistic: Callable[[np.ndarray], Any], column: Callable[[Episodes], np.ndarray]):
    """`Metric.of`: a statistic of a column; None where that is empty."""

    def of(episodes: Episodes) -> float | None:
        values = column(episodes)
        return statistic(values).item() if values.size else None

    return of


def estimated(estimate: Callable[..., Measured], *columns: Callable[[Episodes], np.ndarray]):
    """`Metric.estimate`: one of `estimates` of columns with a number for each episode."""

    def of(by_seed: Sequence[Episodes]) -> Measured:
        return estimate(*(np.stack([column(episodes) for episodes in by_seed]) for column in columns))

    return of


def rate(by_seed: Sequence[Episodes]) -> Measured:
    """Inferences a second, from the mean time of one and its interval."""
    latency = LATENCY(by_seed)
    return Measured(*(None if ms is None else 1000 / ms for ms in (latency.value, latency.high, latency.low)))


def control_rate(episodes: Episodes) -> float | None:
    """Control steps a second of wall time in the episodes, rendering included."""
    wall_s = sum(row[TIMING]["wall_s"] for row in episodes)
    return sum(row["num_steps"] for row in episodes) / wall_s if wall_s > 0 else None


MEAN_MS = plain(np.mean, inference_times)
LATENCY = estimated(estimates.pooled_mean, inference_time_sums, inference_counts)

# The metrics of paper section 4.1 and more, in the order of the columns. A new one is one line here.
METRICS = (
    Metric("avg_return", "avg_reward", plain(np.mean, rewards), "Avg. reward", 2,
           estimate=estimated(estimates.mean, rewards), printed="avg_reward"),
    Metric("median_return", "median", plain(np.median, rewards), "Median", 1,
           estimate=estimated(estimates.median, rewards), printed="median", printed_digits=1),
    Metric("iqm_return", "iqm", plain(estimates.trimmed_mean, rewards),
           estimate=estimated(estimates.interquartile_mean, rewards)),
    Metric("mean_max_reward", "avg_max", plain(np.mean, highest_rewards), "Avg. max", 2,
           estimate=estimated(estimates.mean, highest_rewards), printed="avg_max"),
    Metric("max_return", "max", plain(np.max, rewards)),
    Metric("nonzero_episodes", "nonzero", plain(np.sum, rewarded), "Nonzero", 0, 0,
           share="nonzero_share", printed="nonzero"),
    Metric("nonzero_share", "nonzero_share", plain(np.mean, rewarded), data_digits=6,
           estimate=estimated(estimates.share, rewarded)),
    Metric("success_episodes", "success", plain(np.sum, successes), "Success-like", 0, 0,
           share="success_share", printed="success"),
    Metric("success_share", "success_share", plain(np.mean, successes), data_digits=6,
           estimate=estimated(estimates.share, successes)),
    Metric("inference_ms_mean", "latency_ms", MEAN_MS, "Latency ms", 3,
           estimate=LATENCY, printed="latency_ms", printed_digits=3),
    Metric("inference_ms_median", "latency_ms_median", plain(np.median, inference_times)),
    Metric("inference_ms_p95", "latency_ms_p95", plain(lambda ms: np.percentile(ms, 95), inference_times), "p95 ms", 3),
    Metric("inference_fps", "inference_fps", plain(lambda ms: 1000 / ms.mean(), inference_times), "Inf. FPS", 2,
           estimate=rate, printed="inference_fps", printed_digits=3),
    Metric("chunk_jump", "chunk_jump", plain(np.mean, chunk_jumps), data_digits=6),
    Metric("control_fps", "control_fps", control_rate, "Control FPS", 0),
)  # fmt: skip


def summarise(rows: Episodes) -> dict[str, Any]:
    """Every metric of at least one episode, as plain numbers, with the interval of the success share.

    Times are in ms, rates in 1/s; they are None where no inference was timed.
    """
    return {
        "episodes": len(rows),
        **{metric.name: metric.of(rows) for metric in METRICS},
        "success_interval": list(wilson_interval(int(successes(rows).sum()), len(rows))),
        **({"success_of_goal": success_of_goal(rows)} if "goal" in rows[0] else {}),
        **({"condition_happened": condition_happened(rows)} if "condition_happened" in rows[0] else {}),
        "failures": dict(sorted(Counter(row["failure"] for row in rows if row["failure"]).items())),
    }


def condition_happened(rows: Sequence[Row]) -> list[int]:
    """[episodes in which the event of a condition came, all episodes that say whether it did]."""
    told = [row["condition_happened"] for row in rows if "condition_happened" in row]
    return [sum(told), len(told)]


def success_of_goal(rows: Sequence[Row]) -> dict[str, list[int]]:
    """[successes, episodes] by the task asked for, where one scene serves several tasks."""
    counts: dict[str, list[int]] = {}
    for row in rows:
        count = counts.setdefault(row["goal"], [0, 0])
        count[0] += bool(row["success"])
        count[1] += 1
    return dict(sorted(counts.items()))
