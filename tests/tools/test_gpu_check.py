"""The measurements for a GPU, as far as a CPU goes."""

import json
import runpy
from pathlib import Path

TOOL = Path(__file__).parents[2] / "tools/gpu_check.py"


def test_everything_is_measured_and_written(tmp_path):
    assert runpy.run_path(str(TOOL))["main"](["--device", "cpu", "--quick", "--output", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "gpu_check.json").read_text())
    assert found["worst_loss_difference"] == 0.0
    assert all(row["steps_per_s"] > 0 for row in found["training"].values())
    assert all(row["log_error"] >= 0 for samplers in found["latency"].values() for row in samplers.values())
    assert "Training of socket_ph32_exec16" in (tmp_path / "gpu_check.md").read_text()
