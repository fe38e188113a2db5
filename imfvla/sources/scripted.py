"""Demonstrations of the scripted expert as a source of episodes."""

from collections.abc import Mapping
from typing import Any

from imfvla.sources.collection import ensure_demonstrations
from imfvla.sources.mcap import McapSource


def open_source(config: Mapping[str, Any]) -> McapSource:
    """Exactly the demonstrations that `config` (train.yaml composed) asks for; missing ones are recorded first."""
    return McapSource(ensure_demonstrations(config))
