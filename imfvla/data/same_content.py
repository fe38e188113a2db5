"""Whether a frame store still holds what a policy was trained on."""

import logging
from collections.abc import Mapping

from imfvla.data.frame_store import FrameStore
from imfvla.errors import UserError

DEMONSTRATIONS = "demonstrations"  # the source of the arrays; other files may hold equal episodes
log = logging.getLogger(__name__)


def refuse_other_content(recorded: Mapping[str, str] | None, store: FrameStore, of: str) -> None:
    """Raises UserError naming the arrays that differ from those that `of` was made with: see `FrameStore.content`.

    None was recorded before there were digests: a line says that nothing is compared.
    """
    if recorded is None:
        log.warning("%s does not say which data it was made with: %s is taken as it is.", of, store.path)
        return
    differing = [name for name, digest in store.content.items() if recorded.get(name) != digest]
    arrays = [name for name in differing if name != DEMONSTRATIONS]
    if arrays:
        cause = (
            "the demonstrations were exchanged" if DEMONSTRATIONS in differing else "the store was changed"
        )
        raise UserError(
            f"The data in {store.path} are not those that {of} was made with: {', '.join(arrays)} "
            f"{'differs' if len(arrays) == 1 else 'differ'}; {cause}. Restore the data, or start a new run with "
            "another name=..."
        )
    if differing:
        log.info("%s is made from other files than before, with equal episodes.", store.path)
