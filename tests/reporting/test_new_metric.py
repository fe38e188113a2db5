"""A metric is one line of `METRICS`: every table has it, of evaluations too that are older than it."""

import json
import subprocess
import sys

import pytest

from imfvla.config.assets import folder
from imfvla.reporting.cells import alone
from imfvla.reporting.metrics import Metric

RUN = folder("experiments") / "pretrained" / "socket_ph32_exec16" / "generator=imf_plain"
LINE = 'Metric("mean_steps", "steps", plain(np.mean, column("num_steps")), "Steps", 1)'
SCRIPT = f"""
import json, sys
import numpy as np
from imfvla.reporting import metrics
from imfvla.reporting.metrics import Metric, column, plain

metrics.METRICS = (*metrics.METRICS, {LINE})

from pathlib import Path
from imfvla.reporting.answers import read_evaluated
from imfvla.reporting.results import Result
from imfvla.reporting.runs import rows
from imfvla.reporting.table_row import COLUMNS, as_json, table_of
from imfvla.reporting.tables import other_table
from imfvla.storage.run_directory import RunDirectory

evaluations = rows(RunDirectory(Path(sys.argv[1])))
found = [read_evaluated(evaluation) for evaluation in evaluations]
document = other_table([Result([one]) for one in found])
print(json.dumps({{
    "steps": [sum(row["num_steps"] for row in one.episodes) / len(one.episodes) for one in found],
    "shown": [document.shown.columns, *document.shown.rows],
    "data": [document.data.columns, *document.data.rows],
    "row": [COLUMNS, *(cells for cells in table_of(evaluations).rows if cells[1] == "ours")],
    "json": [as_json(evaluation)["ours"]["mean_steps"] for evaluation in evaluations],
}}))
"""


def test_a_new_metric_is_a_column_of_committed_results():
    """In a process of its own, since the tables take the list when they are imported."""
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, RUN], capture_output=True, text=True, check=True, encoding="utf-8"
    )
    found = json.loads(done.stdout)
    for table, title, digits in (("shown", "Steps", 1), ("data", "steps", 4), ("row", "Steps", 1)):
        head, *rows = found[table]
        cells = [row[head.index(title)] for row in rows]
        assert cells == [f"{value:.{digits}f}" for value in found["steps"]]
    assert found["json"] == pytest.approx(found["steps"])


def test_a_number_that_was_not_measured_is_a_dash():
    for share in (None, "grasp_share"):
        metric = Metric("grasps", "grasps", lambda episodes: None, "Grasps", 0, 0, share=share)
        assert alone(metric, {"grasps": None, "episodes": 4}) == "-"
