"""Whether a run's config.yaml is still the config that its weights were trained with and its episodes played with."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from imfvla.errors import UserError
from imfvla.options import Plain
from imfvla.storage.records import read_record
from imfvla.storage.run_directory import (
    DERIVED_KEYS,
    EXECUTION_KEYS,
    LATER_KEYS,
    RunDirectory,
    config_digest,
    differences,
    digest_of_entries,
    flatten,
    plain,
)

# Keys of policy.json. Evaluations have the second one, which weights of earlier versions have for the first one.
CONFIG, DIGEST, DATA = "config", "config_digest", "data"
REMEDY = "Restore config.yaml, or train with another config under another name=..."
# Keys that digests began to leave out after the first version, in this order. A change of what is left out goes here.
LEFT_OUT_LATER = (
    ("training.compile",),
    ("training.on_non_finite",),
    ("training.sharding",),
    ("demos.frames_directory",),
    DERIVED_KEYS,
)


def digest_of_config(config: Mapping[str, Any]) -> str:
    """16 hex digits of all that a run trains, as policies and evaluations keep it."""
    return config_digest(config, EXECUTION_KEYS)


def refuse_changed_config(run: RunDirectory, config: Mapping[str, Any], step: int) -> None:
    """Raises UserError naming the keys of config.yaml that differ from what the weights of `step` were trained with.

    Weights without `policy.json` beside them are not compared.
    """
    beside, made = _made_by(run, step)
    trained, digest = made.get(CONFIG), made.get(DIGEST)
    if isinstance(trained, Mapping):
        differing = differences(trained, plain(config), EXECUTION_KEYS)
        if differing:
            raise UserError(
                f"{run.path}/config.yaml is not what the weights of step {step} were trained with: "
                f"{'; '.join(differing)}. {REMEDY}"
            )
    if digest is not None and not is_digest_of(config, digest):
        raise UserError(
            f"{run.path}/config.yaml is not what the weights of step {step} were trained with: {beside} has "
            f"{DIGEST} {digest}, found {digest_of_config(config)}. {REMEDY}"
        )


def refuse_other_config(config: Mapping[str, Any], run: Path, file: Path, digest: Any) -> None:
    """Raises UserError where the evaluation `file` states the digest of another config. None was written before."""
    if digest is not None and not is_digest_of(config, digest):
        raise UserError(
            f"{run}/config.yaml is not what {file} was evaluated with: it has {DIGEST} {digest}, found "
            f"{digest_of_config(config)}. {REMEDY}"
        )


def trained_data(run: RunDirectory, step: int) -> Mapping[str, str] | None:
    """Digests of the data that the weights of `step` were trained on; None where they do not say it."""
    _, made = _made_by(run, step)
    data = made.get(DATA)
    return data if isinstance(data, Mapping) else None


def _made_by(run: RunDirectory, step: int) -> tuple[Path, dict[str, Any]]:
    """What the weights of `step` say of their training, and the file that says it; {} where it is missing."""
    path = run.weights_directory(step) / "policy.json"
    return path, read_record(path, Mapping[str, Plain], "restore it", home=run.path) if path.exists() else {}


def is_digest_of(config: Mapping[str, Any], digest: Any) -> bool:
    """Whether a digest that this or an earlier version wrote is of this config."""
    return any(digest == known for known in _known_digests(config))


def _known_digests(config: Mapping[str, Any]) -> Iterator[str]:
    """The present one first, then those of each earlier version."""
    yield digest_of_config(config)
    entries = flatten(plain(config))
    left_out = [key for keys in LEFT_OUT_LATER for key in keys]
    ignored = {key for key in EXECUTION_KEYS if key not in left_out}
    later = list(LATER_KEYS.items())
    versions = [dict(later[:count]) | entries for count in range(len(later) + 1)]
    for keys in ((), *LEFT_OUT_LATER):
        ignored |= {*keys}
        for version in versions:
            yield digest_of_entries(version, tuple(ignored))
