"""The typed tables agree with what the paper's text and its Table 3 say about them."""

import pytest

from imfvla.reporting.mapping import read_mapping
from imfvla.reporting.paper import PaperRow, paper_comparisons, paper_rows
from imfvla.reporting.tables import derived

ROWS = {row.name: row.paper for row in read_mapping().rows if row.paper}
# Sentences of the paper's abstract and sections 4.2 to 4.4: row -> what they repeat of the tables.
TEXT = {
    "socket_infer3": {"avg_reward": 1513.56, "median": 1901.5, "latency_ms": 15.122, "nonzero": 83},
    "socket_infer2": {"avg_reward": 1472.62, "latency_ms": 14.409, "nonzero": 83},
    "socket_ddpm_ph16": {"avg_reward": 861.53, "median": 668.0, "latency_ms": 338.291, "nonzero": 97},
    "socket_ddpm_ph32": {"avg_reward": 1019.39, "median": 804.0, "latency_ms": 397.912},
    "socket_act": {"avg_reward": 289.6, "latency_ms": 100.212},
    "socket_smolvla": {"avg_reward": 466.16, "latency_ms": 2.614},
    "transfer_infer1": {"avg_reward": 526.22, "success": 44},
    "transfer_native_dp": {"avg_reward": 319.2, "success": 29},
    "transfer_resnet_multitoken": {"avg_reward": 260.66, "inference_fps": 441.80},
    "transfer_full_attnres": {"avg_reward": 228.42},
    "transfer_dit_ph32_exec16": {"avg_reward": 49.88},
}
# Where the paper disagrees with itself. Table 1 prints latencies and no rates, and the two ratios of inference FPS in
# Table 3 are not those of the printed latencies: 22.97 against 338.291 / 15.122, 28.45 against 397.912 / 14.409. Both
# are larger by 2.7% and 3.0%, as a mean of rates is larger than the rate of the mean time.
RATES = {
    "Socket iMF infer3 vs ph16 diffusion, Inference FPS": 22.37,
    "Socket iMF infer2 vs ph32 diffusion, Inference FPS": 27.62,
}


def test_seven_and_eleven_rows_of_100_rollouts_each_mapped():
    rows = [*paper_rows(1), *paper_rows(2)]
    assert [len(paper_rows(table)) for table in (1, 2)] == [7, 11]
    assert {row.episodes for row in rows} == {100}
    assert set(ROWS.values()) == set(rows)
    assert all(
        (row.latency_ms is None) == (row.table == 2) == (row.inference_fps is not None) for row in rows
    )


@pytest.mark.parametrize("name", TEXT)
def test_rows_agree_with_the_text(name):
    assert {field: getattr(ROWS[name], field) for field in TEXT[name]} == TEXT[name]


@pytest.mark.parametrize("row", [*paper_rows(1), *paper_rows(2)], ids=lambda row: row.label)
def test_the_columns_of_a_row_fit_together(row: PaperRow):
    top = 5 if row.table == 1 else 4  # the stage that counts as success
    failed = row.nonzero - row.success  # their highest reward is between 1 and top - 1
    assert 0 <= row.success <= row.nonzero <= 100
    assert top * row.success + failed <= 100 * row.avg_max <= top * row.success + (top - 1) * failed
    assert row.avg_reward <= 700 * row.avg_max
    assert (row.median > 0) == (row.nonzero > 50)
    assert (2 * row.median).is_integer()  # rewards of a step are whole numbers


@pytest.mark.parametrize("comparison", read_mapping().of_comparisons("table3"), ids=lambda c: c.paper.label)
def test_table_3_follows_from_tables_1_and_2(comparison):
    row, baseline = comparison.row.paper, comparison.baseline.paper
    result = derived(comparison, row, baseline)
    if comparison.paper.label in RATES:
        assert result == "-"
        ratio = baseline.latency_ms / row.latency_ms
        assert ratio == pytest.approx(RATES[comparison.paper.label], abs=0.005)
        assert 1.02 < float(comparison.paper.result.rstrip("×")) / ratio < 1.04
    else:
        assert result == comparison.paper.result


def test_the_latencies_of_table_1_do_not_grow_with_nfe():
    """The paper says that hardware differs between rows: NFE 1 is printed as slower than NFE 3."""
    assert (
        ROWS["socket_infer1"].latency_ms > ROWS["socket_infer3"].latency_ms > ROWS["socket_infer2"].latency_ms
    )


def test_section_4_4_repeats_seven_of_the_ten_results():
    stated = {"1.76×", "1.48×", "22.97×", "23.48×", "28.45×", "1.65×", "+15"}  # section 4.4
    assert {comparison.result for comparison in paper_comparisons(3)} - stated == {
        "5.23×",
        "3.25×",
        "237.65×",
    }
