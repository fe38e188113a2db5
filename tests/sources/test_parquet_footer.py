"""The number of values of each column, read from the footer of a parquet file without asking pyarrow for a column."""

import random

import pytest

pa = pytest.importorskip("pyarrow")
import pyarrow.parquet as pq  # noqa: E402

from imfvla.sources.lerobot.footer import num_values  # noqa: E402


@pytest.fixture
def path(tmp_path):
    rows = {
        "number": [1, 2, 3],
        "list": [[1.0, 2.0], [], [3.0]],
        "text": ["a", None, "c"],
        "flag": [True, False, True],
    }
    path = tmp_path / "a.parquet"
    pq.write_table(pa.table(rows), path, row_group_size=2, write_page_index=True)
    return path


def test_they_are_those_that_pyarrow_finds(path):
    found = pq.ParquetFile(path).metadata
    columns = [[found.row_group(group).column(number) for number in range(4)] for group in range(2)]
    assert num_values(path) == [[(one.path_in_schema, one.num_values) for one in group] for group in columns]


def test_a_damaged_footer_is_a_value_error_or_other_numbers(path):
    whole = path.read_bytes()
    length = int.from_bytes(whole[-8:-4], "little")
    rng = random.Random(0)
    refused = 0
    for _ in range(300):
        damaged = bytearray(whole)
        for _ in range(3):
            damaged[rng.randrange(len(whole) - 8 - length, len(whole) - 4)] = rng.randrange(256)
        path.write_bytes(damaged)
        try:
            num_values(path)
        except ValueError:
            refused += 1
    assert refused > 50
    for content in (b"", b"PAR1", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="its footer is"):
            num_values(path)
