"""What Hydra offers around a job is honoured in sweeps too, or refused by name before anything runs."""

import pytest
from hydra.core.global_hydra import GlobalHydra

from imfvla.command.composition import CONFIG_DIRECTORY, Places, choices_of, compose
from imfvla.command.entry import entry_point, output_directory
from imfvla.train import usage


@entry_point("train", usage=usage)
def command(config):
    output_directory().mkdir(parents=True, exist_ok=True)
    (output_directory() / "seen").write_text(f"{config['name']} {config['seed']}")


@pytest.fixture(autouse=True)
def _in_tmp(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def mine(tmp_path):
    """A folder of more configs, whose experiment has choices of its own."""
    experiment = tmp_path / "more" / "exp" / "mine.yaml"
    experiment.parent.mkdir(parents=True)
    experiment.write_text('# @package _global_\nname: mine\nhydra: {sweeper: {params: {seed: "0,1"}}}\n')
    return str(tmp_path / "more")


def seen(tmp_path):
    return sorted(path.read_text() for path in tmp_path.rglob("seen"))


@pytest.mark.parametrize("by", ["-m", "hydra.mode=MULTIRUN"])
def test_choices_in_an_experiment_of_another_folder_are_jobs(mine, tmp_path, by):
    command(["--config-dir", mine, "+exp=mine", by])
    assert seen(tmp_path) == ["mine 0", "mine 1"]


def test_the_command_line_wins_over_the_choices_of_an_experiment(mine, tmp_path):
    command(["+exp=mine", "-m", "seed=3,4", "--config-dir", mine])
    assert seen(tmp_path) == ["mine 3", "mine 4"]


def test_without_a_sweep_the_other_folder_is_looked_in_too(mine, tmp_path):
    command(["--config-dir", mine, "+exp=mine"])
    assert seen(tmp_path) == ["mine 0"]


@pytest.mark.parametrize("by", [["--config-dir", "{}"], ["hydra.searchpath=[file://{}]"]])
def test_what_a_command_composes_itself_is_looked_for_there_too(mine, by):
    found = {}

    @entry_point("report")
    def report(config):
        places = Places.of_command()
        GlobalHydra.instance().clear()
        found.update(compose("train", ["+exp=mine"], places), choices=choices_of("exp", "train", places))

    report([text.format(mine) for text in by])
    assert found["name"] == "mine"
    assert {"mine", "socket_act"} < set(found["choices"])
    assert Places.of_command() == Places()


@pytest.mark.parametrize("by", [[], ["-m"], ["+sweep=pair"]])
def test_configs_of_the_search_path_are_found_alone_and_in_sweeps(mine, tmp_path, by):
    (tmp_path / "more" / "sweep").mkdir()
    (tmp_path / "more" / "sweep" / "pair.yaml").write_text("tables: []\njobs: [['+own=a', 'seed=5,6']]\n")
    (tmp_path / "more" / "own").mkdir()
    (tmp_path / "more" / "own" / "a.yaml").write_text("# @package _global_\nname: of_own_group\n")
    group = [] if by == ["+sweep=pair"] else ["+own=a", "seed=5,6" if by else "seed=5"]
    command([*by, f"hydra.searchpath=[file://{mine}]", *group])
    assert seen(tmp_path) == ["of_own_group 5", "of_own_group 6"][: 2 if by else 1]


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("file://nowhere", "hydra.searchpath names 'file://nowhere', which is not a directory"),
        ("pkg://no_such_package.conf", "names 'pkg://no_such_package.conf', which is not a package"),
        ("http://x", "hydra.searchpath takes file://DIR and pkg://NAME, found 'http://x'"),
    ],
)
def test_a_place_that_does_not_exist_is_refused(tmp_path, capfd, place, message):
    for more in ([], ["-m"]):
        with pytest.raises(SystemExit) as exit_:
            command([f"hydra.searchpath=['{place}']", "seed=1", *more])
        assert exit_.value.code == 2
        assert message in capfd.readouterr().err
    assert seen(tmp_path) == []


@pytest.mark.parametrize("by", ["--config-dir", "hydra.searchpath"])
def test_a_typing_error_beside_configs_of_ones_own_is_named(mine, capfd, by):
    places = [by, mine] if by.startswith("--") else [f"hydra.searchpath=[{mine}]"]
    for wrong, message in (("sede=1", "did you mean seed?"), ("+own=a", "Unknown key own")):
        with pytest.raises(SystemExit):
            command([*places, "+exp=mine", wrong])
        assert message in capfd.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["-m", "seed=0,1", "hydra.sweeper._target_=some.Sweeper"], "hydra/sweeper must be basic"),
        (
            ["-m", "seed=0,1", "hydra.sweeper.max_batch_size=0"],
            "hydra.sweeper.max_batch_size must be null or",
        ),
        (["-m", "seed=0,1", "hydra.sweep.subdir=one"], "would share runs/one, though seed was 0, is 1"),
        (["-m", "seed=0,1", "hydra.sweep.subdir=${hydra.job.num}"], "hydra.sweep.subdir must depend only on"),
        (["--config-dir", "{more}", "-m", "+exp=mine,socket_act"], "has hydra.sweeper.params of its own"),
        (["-m", "+hydra.sweeper.params.seed='0,1'"], "hydra.sweeper.params.seed works only in a config"),
        (["seed=0", "hydra.job.chdir=true"], "hydra.job.chdir must be false"),
    ],
)
def test_what_cannot_be_honoured_is_refused(mine, tmp_path, capfd, arguments, message):
    with pytest.raises(SystemExit) as exit_:
        command([text.replace("{more}", mine) for text in arguments])
    assert exit_.value.code == 2
    assert message in capfd.readouterr().err
    assert seen(tmp_path) == []


def test_nothing_typed_is_answered_with_the_experiments_that_exist(tmp_path, capfd):
    for arguments in ([], ["-m"]):
        with pytest.raises(SystemExit) as exit_:
            command(arguments)
        assert exit_.value.code == 2
        printed = capfd.readouterr().err
        assert "python -m imfvla.train +exp=NAME" in printed
        assert all(path.stem in printed for path in (CONFIG_DIRECTORY / "exp").glob("*.yaml"))
    assert list(tmp_path.iterdir()) == []
    command(["task=transfer"])
    assert seen(tmp_path) == ["transfer 0"]
