"""The console scripts: `imfvla-train ...` is `python -m imfvla.train ...`."""

from collections.abc import Callable
from importlib import import_module

from imfvla.command import begin


def _script(name: str) -> Callable[[], None]:
    def script() -> None:
        begin()
        import_module(f"imfvla.{name}").main()

    return script


bench = _script("bench")
collect = _script("collect")
compare = _script("compare")
convert = _script("convert")
evaluate = _script("evaluate")
export = _script("export")
gallery = _script("gallery")
report = _script("report")
train = _script("train")
