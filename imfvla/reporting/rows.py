"""The line of `episodes.jsonl` that an episode becomes, and what is read from it."""

from typing import Any

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
        **({} if result.chunk_jump is None else {"chunk_jump": round(result.chunk_jump, 9)}),
        **({} if result.condition_happened is None else {"condition_happened": result.condition_happened}),
        TIMING: {
            "wall_s": round(result.wall_s, 6),
            "inference_ms": [round(value, 3) for value in result.inference_ms],
        },
    }


def untimed(row: Row) -> dict[str, Any]:
    """The row without its times: equal for equal runs."""
    return {key: value for key, value in row.items() if key != TIMING}


def first_failed_stage(row: Row) -> int | None:
    """The index of the first stage that never held, None where all of them did."""
    return next((index for index, step in enumerate(row["first_step_of_stage"]) if step < 0), None)
