"""Which packages register their environments for a task, and what is said where one does not."""

import sys

import pytest

pytest.importorskip("gymnasium", reason="the extra gym is not installed")

import gymnasium
from worlds import OBSERVATION, config

from imfvla.errors import UserError
from imfvla.gymnasium_env import load, packages

MODULE = """
import gymnasium

calls = []

def register_envs():
    calls.append(1)
    gymnasium.register("{name}/Slider-v0", entry_point="{name}:Slider")

def fail():
    raise RuntimeError("no simulator here")

from worlds import Slider as Base

class Slider(Base):
    pass
"""


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Makes a package as its files lie after an installation, with the given lines of `gymnasium.envs`."""
    monkeypatch.syspath_prepend(tmp_path)
    names = []

    def make(name: str, *points: str, module: str = MODULE) -> None:
        names.append(name)
        folder = tmp_path / f"{name}-1.2.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.2\n")
        (folder / "entry_points.txt").write_text("\n".join(["[gymnasium.envs]", *points]) + "\n")
        (tmp_path / f"{name}.py").write_text(module.format(name=name))

    yield make
    for name in names:
        sys.modules.pop(name, None)
        for found in [found for found in gymnasium.registry if found.startswith(f"{name}/")]:
            del gymnasium.registry[found]


def test_a_version_is_that_of_the_distribution_whatever_its_name(install, tmp_path):
    install("slides_here", "__root__ = slides_here:register_envs")
    assert packages.version_of("slides_here") == "slides_here 1.2"
    (tmp_path / "slides_here-1.2.dist-info" / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: My-Robot\nVersion: 3.4\n"
    )
    assert packages.version_of("slides_here") == "slides_here 3.4"
    assert packages.version_of("nowhere_at_all") == "nowhere_at_all"


def test_other_packages_are_not_imported(monkeypatch):
    monkeypatch.delitem(sys.modules, "this", raising=False)
    with pytest.raises(UserError, match="nothing else is imported"):
        packages.register("this", "X-v0")
    assert "this" not in sys.modules
    point = packages.metadata.EntryPoint("worlds", "this.part:Thing", "imfvla.components")
    monkeypatch.setattr(
        packages.metadata, "entry_points", lambda group: [point] if group == "imfvla.components" else []
    )
    assert "this" in packages.allowed_packages()


@pytest.mark.parametrize("named", [True, False])
def test_the_function_of_an_entry_point_is_called_once(install, named):
    name = f"by_function_{named}".lower()
    install(name, f"__root__ = {name}:register_envs")
    for _ in range(2):
        task = config(id=f"{name}/Slider-v0", package=name if named else None)
        load(task, OBSERVATION).close()
    assert sys.modules[name].calls == [1]


def test_a_module_alone_is_imported(install):
    install("by_module", "any = by_module", module=MODULE + "\nregister_envs()\n")
    load(config(id="by_module/Slider-v0"), OBSERVATION).close()


def test_no_other_package_is_imported_for_an_environment_that_is_registered(install):
    install("not_needed", "__root__ = not_needed:fail")
    load(config(), OBSERVATION).close()
    assert "not_needed" not in sys.modules


def test_a_package_that_registers_another_id_is_named_with_what_it_registers(install):
    install("other_id", "__root__ = other_id:register_envs")
    with pytest.raises(
        UserError, match=r"task\.package=other_id is imported, but registers nothing under"
    ) as error:
        load(config(id="other_id/Glider-v0", package="other_id"), OBSERVATION)
    assert "it registers other_id/Slider-v0" in str(error.value)


def test_a_package_that_registers_nothing_is_told(install):
    install("silent", "any = silent")
    with pytest.raises(UserError, match=r"but registers nothing under .* registers nothing"):
        load(config(id="silent/Slider-v0", package="silent"), OBSERVATION)


@pytest.mark.parametrize("package", ["failing", None])
def test_a_failing_entry_point_is_named_with_its_reason(install, package):
    install("failing", "__root__ = failing:fail")
    with pytest.raises(UserError, match=r"__root__ = 'failing:fail'.*RuntimeError: no simulator here"):
        load(config(id="failing/Slider-v0", package=package), OBSERVATION)


def test_a_package_that_cannot_be_imported_is_named(install):
    install("broken", "any = broken", module="import nowhere_to_be_found")
    with pytest.raises(UserError, match=r"task\.package=broken cannot be imported .*nowhere_to_be_found"):
        load(config(id="broken/Slider-v0", package="broken"), OBSERVATION)
