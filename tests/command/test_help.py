import pytest

from imfvla import report, train


def printed(command, *arguments, capsys):
    command.main(["--help", *arguments])
    return capsys.readouterr().out


def test_help_says_what_the_command_does_and_lists_groups_and_keys(capsys):
    text = printed(train, capsys=capsys)
    assert text.startswith("python -m imfvla.train +exp=NAME: collects what is missing")
    assert "\ngenerator: act, ddpm, ddpm_adaptive, flow" in text
    assert "\n+exp: aloha_insertion_act, " in text
    assert "\nseed: 0\n" in text
    assert "\nhydra" not in text
    assert max(map(len, text.split("Keys,")[0].splitlines())) <= 110


def test_help_shows_no_group_where_the_config_has_none(capsys):
    text = printed(report, capsys=capsys)
    assert "Groups" not in text
    assert "+exp:" not in text
    assert "\nrun: null\n" in text


def test_help_is_of_the_config_that_the_overrides_make(tmp_path, capsys):
    (tmp_path / "exp").mkdir()
    (tmp_path / "exp/mine.yaml").write_text("# @package _global_\nname: mine\n")
    text = printed(train, "+exp=mine", "seed=7", "--config-dir", str(tmp_path), capsys=capsys)
    assert "\nname: mine\nseed: 7\n" in text
    assert "gate, mine, multitask" in text.replace("\n  ", " ")


def test_help_with_a_typo_is_an_error(capsys):
    with pytest.raises(SystemExit) as exit:
        train.main(["--help", "taks=socket"])
    assert exit.value.code == 2
    assert "did you mean task?" in capsys.readouterr().err
