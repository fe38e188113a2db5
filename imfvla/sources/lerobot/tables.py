"""Parquet files of a LeRobot data set, in bounded memory: only the columns and rows that are asked for."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from imfvla.sources.checks import (
    MAX_EPISODES,
    MAX_STEPS,
    misfit,
    missing_extra,
    read_errors_told,
    shortened,
)
from imfvla.sources.lerobot.footer import num_values
from imfvla.sources.lerobot.layout import DOWNLOAD, INFO, TASKS, Info
from imfvla.storage.opening import ANYWHERE, DATA, checked

try:
    import pyarrow as pa
    import pyarrow.compute as pc
    import pyarrow.parquet as pq
except ImportError as error:
    raise missing_extra("lerobot", error) from error

BATCH = 1024  # rows in memory at a time
MAX_TASKS, MAX_SENTENCE = 100_000, 10_000
# What a damaged file makes pyarrow raise.
OF_DAMAGE = (pa.ArrowException, OSError, ValueError, KeyError, IndexError, OverflowError, RuntimeError)
MAX_ROW_BYTES = 2 * 2**30  # of the rows of one episode
MAX_GROUP_VALUES = 2**28  # of a column of a row group: a list of equal numbers takes no space in the file


@dataclass(frozen=True, slots=True)
class Episodes:
    """The table meta/episodes: arrays (E,), one entry an episode."""

    length: np.ndarray
    data: np.ndarray  # int64 (E, 2)  chunk and file
    first_row: np.ndarray  # int64 (E,)  within its data file
    videos: Mapping[
        str, tuple[np.ndarray, np.ndarray]
    ]  # key -> int64 (E, 2) chunk and file, float64 (E,) seconds


def read_episodes(info: Info, video_keys: Sequence[str]) -> Episodes:
    """Where each episode lies. Raises UserError where the table does not fit meta/info.json or is damaged."""
    files = sorted((info.root / "meta" / "episodes").glob("*/*.parquet"))
    whole = ["episode_index", "length", "dataset_from_index", "dataset_to_index"]
    places = ["data/chunk_index", "data/file_index"]
    for key in video_keys:
        places += [f"videos/{key}/chunk_index", f"videos/{key}/file_index"]
    times = [f"videos/{key}/from_timestamp" for key in video_keys]
    names = [*whole, *places, *times]
    found: dict[str, list[np.ndarray]] = {name: [] for name in names}
    total = sum(_num_rows(path, info.home) for path in files)
    if total != info.num_episodes:
        raise misfit(
            info.root / "meta/episodes",
            "its number of rows",
            f"{info.num_episodes}, as {INFO} states",
            total,
            DOWNLOAD,
        )
    for path in files:
        for table in batches(path, names, 0, None):
            for name in names:
                found[name].append(_scalars(table, name, path))
    column = {name: np.concatenate(parts) for name, parts in found.items()}
    place = info.root / "meta/episodes"
    for name in (*whole, *places):
        if len(column[name]) and not (
            np.equal(np.mod(column[name], 1), 0).all() and (column[name] >= 0).all()
        ):
            raise misfit(place, name, "whole numbers from 0 on", column[name][:5].tolist(), DOWNLOAD)
        column[name] = column[name].astype(np.int64)
    if not np.isfinite([column[name] for name in times]).all():
        raise misfit(place, ", ".join(times), "finite", "NaN", DOWNLOAD)
    expected = np.arange(total)
    if not np.array_equal(column["episode_index"], expected):
        raise misfit(place, "episode_index", "0, 1, 2, ...", column["episode_index"][:5].tolist(), DOWNLOAD)
    length = column["dataset_to_index"] - column["dataset_from_index"]
    if not np.array_equal(length, column["length"]) or length.min() < 1 or length.max() > MAX_STEPS:
        episode = int(np.argmax((length != column["length"]) | (length < 1) | (length > MAX_STEPS)))
        raise misfit(
            place,
            f"length of episode {episode}",
            f"1 to {MAX_STEPS}, and dataset_to_index - dataset_from_index",
            int(column["length"][episode]),
            DOWNLOAD,
        )
    data = np.stack([column[name] for name in places[:2]], 1)
    _, file = np.unique(data, axis=0, return_inverse=True)
    first = np.full(total, np.iinfo(np.int64).max)
    np.minimum.at(first, file.ravel(), column["dataset_from_index"])
    videos = {
        key: (
            np.stack([column[f"videos/{key}/{part}_index"] for part in ("chunk", "file")], 1),
            column[f"videos/{key}/from_timestamp"].astype(np.float64),
        )
        for key in video_keys
    }
    return Episodes(length, data, column["dataset_from_index"] - first[file.ravel()], videos)


def read_tasks(info: Info) -> dict[int, str]:
    """The sentence of each task_index. Raises UserError where the table is missing or damaged."""
    path = info.root / TASKS
    with clear_errors(path), pq.ParquetFile(checked(path, DATA, home=info.home)) as file:
        if file.metadata.num_rows > MAX_TASKS:
            raise misfit(path, "its number of rows", f"at most {MAX_TASKS}", file.metadata.num_rows, DOWNLOAD)
        names = file.schema_arrow.names
    text = "task" if "task" in names else "__index_level_0__"
    tasks: dict[int, str] = {}
    for table in batches(path, ["task_index", text], 0, None):
        for number, sentence in zip(table["task_index"].to_pylist(), table[text].to_pylist(), strict=True):
            if not isinstance(number, int) or not isinstance(sentence, str) or len(sentence) > MAX_SENTENCE:
                raise misfit(
                    path, "task_index, task", "a whole number and a sentence", (number, sentence), DOWNLOAD
                )
            tasks[number] = sentence
    return tasks


def read_rows(path: Path, columns: Sequence[str], first: int, count: int) -> pa.Table:
    """Rows `first` to `first + count` of these columns. Raises UserError where the file lacks them or is damaged."""
    parts = list(batches(path, columns, first, count))
    if (found := sum(len(part) for part in parts)) != count:
        raise misfit(path, "its number of rows", f"at least {first + count}", first + found, DOWNLOAD)
    return pa.concat_tables(parts)


def batches(path: Path, columns: Sequence[str], first: int, count: int | None) -> Iterator[pa.Table]:
    """The rows from `first` on, at most `BATCH` at a time; only row groups with wanted rows are read.

    `path` is a file that `layout.inside` gave, or one checked to lie in the data set.
    """
    with clear_errors(path), pq.ParquetFile(checked(path, DATA, home=ANYWHERE), memory_map=True) as file:
        known = file.schema_arrow.names
        if lacking := [name for name in columns if name not in known]:
            raise misfit(
                path,
                "its columns",
                f"with {', '.join(lacking)}",
                ", ".join(known),
                "choose features that it has",
            )
        last = file.metadata.num_rows if count is None else first + count
        row, groups, skip, counts = 0, [], first, num_values(path)
        for group in range(file.num_row_groups):
            num_rows = file.metadata.row_group(group).num_rows
            if row < last and row + num_rows > first:
                skip = skip if groups else first - row
                groups.append(group)
                _check_group(counts[group], columns, path)
            row += num_rows
        left, num_bytes = last - first, 0
        for batch in file.iter_batches(BATCH, row_groups=groups, columns=list(columns), use_threads=False):
            table = pa.Table.from_batches([batch]).slice(skip, left)
            skip = max(0, skip - batch.num_rows)
            if len(table):
                left -= len(table)
                num_bytes += table.nbytes
                if count is not None and num_bytes > MAX_ROW_BYTES:
                    raise misfit(path, "an episode", f"at most {MAX_ROW_BYTES} bytes", "more", DOWNLOAD)
                yield table.select(list(columns))
            if left <= 0:
                return


def _check_group(counts: Sequence[tuple[str, int]], columns: Sequence[str], path: Path) -> None:
    """Raises UserError where a column would fill the memory when it is unpacked."""
    for column, count in counts:
        name = next((name for name in columns if f"{column}.".startswith(f"{name}.")), None)
        if name is not None and count > MAX_GROUP_VALUES:
            wanted = f"at most {MAX_GROUP_VALUES} values in a row group"
            raise misfit(path, f"column {name}", wanted, count, "rewrite the file in smaller row groups")


def vectors(table: pa.Table, name: str, width: int, path: Path) -> np.ndarray:
    """A column of lists of `width` numbers, or of plain numbers where the width is 1: (rows, width)."""
    column = table[name].combine_chunks()
    kind = column.type
    if pa.types.is_fixed_size_list(kind) or pa.types.is_list(kind) or pa.types.is_large_list(kind):
        lengths = pc.unique(pc.list_value_length(column)).to_pylist()
        if column.null_count or lengths != [width]:
            raise misfit(path, f"column {name}", f"lists of {width} numbers", f"lists of {lengths}", DOWNLOAD)
        return _plain(pc.list_flatten(column), name, path).reshape(-1, width)
    if width != 1:
        raise misfit(path, f"column {name}", f"lists of {width} numbers", str(kind), DOWNLOAD)
    return _plain(column, name, path)[:, None]


def scalars(table: pa.Table, name: str, path: Path) -> np.ndarray:
    """A column of plain numbers: (rows,)."""
    return vectors(table, name, 1, path)[:, 0]


def _scalars(table: pa.Table, name: str, path: Path) -> np.ndarray:
    return scalars(table, name, path).astype(np.float64)


def _plain(column: pa.Array, name: str, path: Path) -> np.ndarray:
    kind = column.type
    if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_boolean(kind)):
        raise misfit(path, f"column {name}", "numbers", str(kind), "choose another feature")
    if column.null_count:
        raise misfit(path, f"column {name}", "numbers", f"{column.null_count} empty values", DOWNLOAD)
    return column.to_numpy(zero_copy_only=False)


def _num_rows(path: Path, home: Path) -> int:
    with clear_errors(path), pq.ParquetFile(checked(path, DATA, home=home)) as file:
        count = file.metadata.num_rows
    if count > MAX_EPISODES:
        raise misfit(path, "its number of rows", f"at most {MAX_EPISODES}", count, DOWNLOAD)
    return count


def clear_errors(path: Path) -> AbstractContextManager[None]:
    """Turns what pyarrow raises into a UserError that tells damage from what is not supported."""
    return read_errors_told(
        path,
        "a parquet file",
        DOWNLOAD,
        # pyarrow's own error of that kind is a NotImplementedError too
        lambda error: (
            f"is not supported by pyarrow {pa.__version__} ({shortened(_line(error))}): rewrite it with LeRobot."
        ),
        lambda error: f"is no whole parquet file ({shortened(_line(error))}); {DOWNLOAD}.",
        OF_DAMAGE,
    )


def _line(error: Exception) -> str:
    return " ".join(str(error).split())
