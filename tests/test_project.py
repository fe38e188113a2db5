"""What the project's files promise: pins for every dependency, documented targets, commands that exist."""

import ast
import re
import subprocess
import tomllib
from itertools import chain
from pathlib import Path

import pytest

from imfvla.command.composition import compose
from imfvla.command.line import in_hydras_words
from imfvla.policy import build_policy

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("*.md")])


def pins() -> dict[str, str]:
    files = (ROOT / "constraints.txt", ROOT / "constraints-ray.txt")
    lines = [line for path in files for line in path.read_text().splitlines()]
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {name.lower().replace("_", "-"): version for name, version in pairs}


def make_targets() -> list[str]:
    return re.search(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE).group(1).split()


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *chain(*project["optional-dependencies"].values())]
    names = {re.match(r"[\w.-]+", requirement).group().lower() for requirement in wanted}
    assert not names - pins().keys() - {project["name"]}


def test_pins_name_no_place_and_no_local_version():
    assert all(re.fullmatch(r"[\w.]+", version) for version in pins().values())


def test_the_makefile_documents_every_target():
    printed = subprocess.run(["make", "help"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    for target in make_targets():
        assert re.search(rf"^  {target} +\S", printed, re.MULTILINE), target


def commands_in(documents: list[Path]) -> list[str]:
    """Entry and arguments of every `python -m imfvla.<entry> ...` whose line holds nothing to fill in."""
    text = "\n".join(document.read_text() for document in documents)
    found = re.findall(
        r"^ *(?:\.venv/bin/)?python -m imfvla\.(\w+ [^#\n<>]+)$", re.sub(r" +#.*", "", text), re.MULTILINE
    )
    return sorted(set(found))


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_only_what_exists(document):
    text = document.read_text()
    for module in set(re.findall(r"python -m (imfvla\.\w+)", text)):
        assert (ROOT / (module.replace(".", "/") + ".py")).exists(), module
    for experiment in set(re.findall(r"\+exp=(\w+)", text)):
        assert (ROOT / "conf" / "exp" / f"{experiment}.yaml").exists(), experiment
    code = " ".join(re.findall(r"```.*?```|`[^`]+`", text, re.DOTALL))
    for target in set(re.findall(r"\bmake ([a-z-]+)", code)):
        assert target in make_targets(), target
    for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", text):
        assert (document.parent / link).exists(), link


def names_a_key(argument: str) -> bool:
    """Whether it is an override, and not the path of a run, which may have an equals sign as well."""
    return "=" in argument and not argument.startswith(("experiments/", "runs/"))


@pytest.mark.parametrize("command", commands_in(DOCUMENTS))
def test_commands_in_documents_compose_and_build(command):
    entry, *arguments = command.split()
    # Of a sweep, the first choice of each key.
    overrides = [
        re.sub(r"^(?!nfe=)([^=]+=[^,]+),.*$", r"\1", text) for text in arguments if names_a_key(text)
    ]
    overrides = [re.sub(r"^nfe=(.*)$", r"nfe=[\1]", text) for text in overrides]
    config = compose(entry, in_hydras_words(overrides))
    if entry == "train":
        build_policy(config)


# A package, or a module of the root, imports only from lines above its own.
LAYERS = [
    "draws errors types",
    "options process",
    "config robot",
    "storage",
    "nn",
    "encoders environment generators",
    "episode",
    "conditions gymnasium_env reporting tasks",
    "environments recording",
    "sources",
    "robot_of",
    "data figures",
    "policy",
    "training",
    "runtime",
    "modes rollouts",
    "deployment",
    "command",
    "benchmarks",
    "bench collect convert evaluate gallery report scripts train",
    "compare export",
]
LAYER = {room: number for number, rooms in enumerate(LAYERS) for room in rooms.split()}
# What some of them must not know, though it lies above them: nn no robot, tables no simulator.
ONLY = {
    "encoders": "errors nn types",
    "generators": "draws errors nn options",
    "nn": "draws errors options storage",
    "reporting": "config episode errors options process robot storage",
    "storage": "config errors options process",
}
SIMULATE = "tasks gymnasium_env"
WHO_MAY = {  # of the heavy packages
    "torch": "draws types nn encoders generators data policy training runtime modes rollouts deployment command "
    "benchmarks bench",
    "mujoco": f"{SIMULATE} conditions",
    "dm_control": SIMULATE,
}


def room_of(path: Path) -> str:
    return path.relative_to(ROOT / "imfvla").parts[0].removesuffix(".py")


ROOMS = {room_of(path) for path in (ROOT / "imfvla").rglob("*.py")} - {"__init__"}


def test_every_package_has_its_layer():
    assert LAYER.keys() == ROOMS


@pytest.mark.parametrize("room", LAYER)
def test_imports_run_one_way(room):
    below = {name for name in LAYER if LAYER[name] < LAYER[room]}
    allowed = {room} | (set(ONLY[room].split()) if room in ONLY else below)
    allowed |= {name for name, rooms in WHO_MAY.items() if room in rooms.split()}
    files = [path for path in (ROOT / "imfvla").rglob("*.py") if room_of(path) == room]
    found = {name: path.name for path in files for name in imported(path)}
    assert not {name: file for name, file in found.items() if name not in allowed}


def imported(path: Path) -> set[str]:
    """Parts of imfvla, and heavy packages, that a file imports anywhere."""
    modules = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            modules |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            modules |= {f"{node.module}.{name.name}" for name in node.names}
    parts = {module.split(".")[1] for module in modules if module.startswith("imfvla.")} & ROOMS
    return parts | ({module.split(".")[0] for module in modules} & WHO_MAY.keys())


SOURCES = sorted([*(ROOT / "imfvla").rglob("*.py"), *(ROOT / "tools").rglob("*.py")])
COMMANDS = [
    path
    for path in SOURCES
    if 'if __name__ == "__main__":' in path.read_text(encoding="utf-8")
    # no user's command: a child whose output is captured, and which loads nothing of imfvla
    and path.name != "gl_probe.py"
]


def test_text_is_read_and_written_as_utf_8_whatever_the_locale():
    offenders = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for path in SOURCES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and takes_the_locales_encoding(node)
    ]
    assert not offenders


def takes_the_locales_encoding(call: ast.Call) -> bool:
    """Whether a call of `open`, `Path.read_text`, `subprocess.run` or the like leaves the encoding to the locale."""
    method = call.func.attr if isinstance(call.func, ast.Attribute) else None
    words = {word.arg: ast.unparse(word.value) for word in call.keywords}
    if "encoding" in words:
        return False
    if method in ("read_text", "write_text"):
        return True
    if words.get("text") == "True" or words.get("universal_newlines") == "True":
        return True
    is_builtin = isinstance(call.func, ast.Name) and call.func.id == "open"
    arguments = call.args[1:] if is_builtin else call.args
    mode = words.get("mode") or (ast.unparse(arguments[0]) if arguments else "'r'")
    return (is_builtin or (method == "open" and not arguments)) and "b" not in mode


def test_every_command_begins_before_its_other_imports():
    """Then Ctrl-C prints no traceback while they are loaded, and standard output takes any character."""
    assert not [path.relative_to(ROOT) for path in COMMANDS if not begins_first(path)]


def begins_first(command: Path) -> bool:
    body = ast.parse(command.read_text(encoding="utf-8")).body
    guard = next((number for number, node in enumerate(body) if isinstance(node, ast.If)), len(body))
    before = {node.module for node in body[:guard] if isinstance(node, ast.ImportFrom)}
    before |= {name.name for node in body[:guard] if isinstance(node, ast.Import) for name in node.names}
    begins = guard < len(body) and ast.unparse(body[guard]).endswith("\n    begin()")
    return begins and before <= {"imfvla.command", "sys", "pathlib"}


@pytest.mark.parametrize(
    "left",
    [
        "pretrained/socket_ph32_exec16/generator=imf_plain/table_row.md",
        "pretrained/socket_ph32_exec16/generator=imf_plain/rollouts/seeds100000-100099_nfe4/summary.json",
        "results/socket_act/default/table_row.json",
        "report/index.html",
    ],
)
def test_what_evaluating_and_reporting_leave_in_the_checkout_is_ignored(left):
    if not (ROOT / ".git").exists():
        pytest.skip("not a checkout")
    ignored = subprocess.run(["git", "check-ignore", "-q", f"experiments/{left}"], cwd=ROOT, check=False)
    assert ignored.returncode == 0
