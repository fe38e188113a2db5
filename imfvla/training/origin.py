"""What a training was begun with: its config, which must stay, and its code, every version of which is kept."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.storage.fingerprint import code_version, describe_code
from imfvla.storage.run_directory import EXECUTION_KEYS, differences, plain

CODE, EARLIER, CONFIG = "code", "earlier_code", "config"  # keys of a state, the second one of weights too
log = logging.getLogger(__name__)


class Origin:
    """Kept in every saved state, compared where a training resumes. `config` is None where there is none."""

    def __init__(self, config: Mapping[str, Any] | None) -> None:
        self._config = None if config is None else plain(config)
        # Looked up now: files may change while it trains, the code that runs does not.
        self._code = code_version()
        self._earlier: list[dict[str, Any]] = []  # {"until_step", "code"}, oldest first

    def resume(self, details: Mapping[str, Any], state: Path) -> None:
        """Takes over what a state says.

        Other code is a line in the log and stays on record. Raises UserError naming the keys of the config that differ.
        """
        before, now = details.get(CODE), self._code
        self._earlier = list(details.get(EARLIER, []))
        if before is not None and any(before.get(key) != now[key] for key in now):
            self._earlier.append({"until_step": details["step"], CODE: before})
            log.warning(f"resuming with other code: was {describe_code(before)}, is {describe_code(now)}")
        config = details.get(CONFIG)
        if config is not None and self._config is not None:
            differing = differences(config, self._config, EXECUTION_KEYS)
            if differing:
                raise UserError(
                    f"{state} was saved with another config: {'; '.join(differing)}. Restore the config, or choose "
                    "another name=..."
                )

    def versions(self) -> dict[str, Any]:
        """Of the code before the present one, for those who use the weights; empty where there was none."""
        return {EARLIER: self._earlier} if self._earlier else {}

    def to_json(self) -> dict[str, Any]:
        """For the details of a state."""
        return {CODE: self._code, CONFIG: self._config, **self.versions()}
