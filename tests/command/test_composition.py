import pytest

from imfvla.command.composition import compose
from imfvla.errors import UserError


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+exp=nope"], r"Unknown exp 'nope': there are .*socket_ph32_exec16, .*transfer_ph32_exec16"),
        (["+exp=socket_ph32_exec1"], r"did you mean socket_ph32_exec16\?"),
        (["exp=socket_ph32_exec16"], r"write \+exp=socket_ph32_exec16 instead of exp=socket_ph32_exec16"),
        (["+epx=socket_ph32_exec16"], r"Unknown key epx: at the top are .*training"),
        (["task=chess"], r"Unknown task 'chess': there are .*socket, transfer"),
        (["traning.steps=3"], r"Unknown key traning\.steps \(did you mean training\?\): at the top are"),
        (
            ["training.stps=3"],
            r"Unknown key training\.stps \(did you mean steps\?\): in training are .*steps",
        ),
        (["+training.stps=3"], r"Unknown key training\.stps"),
        (["training.steps.more=3"], r"Unknown key training\.steps\.more"),
        (["+seed=3"], r"seed exists already: write seed=\.\.\. without a plus sign"),
        (["training.steps"], r"Cannot read the override 'training\.steps': wanted key=value"),
        (["observation.views=[front"], r"Cannot read the override"),
        (["encoder=[1]"], r"encoder must be one of its files, found the list \[1\]: write encoder=NAME"),
        (["task=[socket,transfer]"], r"task must be one of its files, .* -m with task=A,B"),
        (
            ["horizon=[1]"],
            r"^horizon must be a mapping of keys to values, found a list: write it as in .*conf\.",
        ),
        (["evaluation.nfe={one: 1}"], r"^evaluation\.nfe must be a list, found a mapping"),
    ],
)
def test_mistakes_get_one_sentence_with_the_names_that_exist(overrides, message):
    with pytest.raises(UserError, match=message) as caught:
        compose("train", overrides)
    assert "\n" not in str(caught.value)


def test_a_value_that_a_command_does_not_have_is_named():
    with pytest.raises(
        UserError,
        match=r"^task\.robot\.cameras\[0\]\.height takes .* observation\.image_size\[0\], which gallery",
    ):
        compose("gallery", ["task=pusht"])


def test_all_missing_values_are_named_at_once_with_what_they_may_be():
    with pytest.raises(UserError, match=r"^Missing values of demos\.action .*, demos\.control_hz ") as caught:
        compose("train", ["task=none", "demos=hdf5", "demos.instruction=go", "name=x"])
    text = str(caught.value)
    for part in (
        "demos.layout (robomimic or act)",
        "demos.path (a file",
        "demos.state",
        "conf/demos/hdf5.yaml",
    ):
        assert part in text
    assert "demos.instruction" not in text


def test_one_missing_value_is_named():
    with pytest.raises(
        UserError, match=r"^Missing value of demos\.path .*demos\.path=\.\.\.; see conf/demos/lerobot"
    ):
        compose("train", ["task=none", "demos=lerobot", "name=x"])


def test_gives_plain_values():
    config = compose("train", ["horizon.pred=8", "horizon.exec=4"])
    assert type(config) is type(config["horizon"]) is dict
    assert type(config["observation"]["views"]) is list
    assert config["horizon"] == {"obs": 1, "pred": 8, "exec": 4, "ensemble": None, "prefix_max": 0}


def test_command_line_wins_over_experiment_over_scale():
    config = compose("train", ["+exp=transfer_ph32_exec16", "scale=paper", "training.batch_size=3"])
    assert config["name"] == "transfer_ph32_exec16"
    assert config["task"]["name"] == "transfer"
    assert config["observation"]["image_size"] == [224, 224]
    assert config["training"]["batch_size"] == 3
