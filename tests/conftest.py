"""Fixtures that several packages' tests share."""

from pathlib import Path

import pytest
from synthetic import write_demonstrations


@pytest.fixture
def synthetic_demonstrations(tmp_path: Path) -> Path:
    """A directory of three recorded episodes: 24 steps, three views of 32 x 32 at every second step."""
    return write_demonstrations(tmp_path / "demonstrations")
