"""Fixtures that several packages' tests share."""

import sys
from pathlib import Path

import pytest
from absl.logging import get_absl_handler
from synthetic import write_demonstrations

# It would hold the stream that pytest captures, and close it when Hydra sets up logging.
get_absl_handler().python_handler.setStream(sys.__stderr__)


@pytest.fixture
def synthetic_demonstrations(tmp_path: Path) -> Path:
    """A directory of three recorded episodes: 24 steps, three views of 32 x 32 at every second step."""
    return write_demonstrations(tmp_path / "demonstrations")
