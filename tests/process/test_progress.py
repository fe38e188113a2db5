"""What a bar shows without a terminal, and bars inside bars on one."""

import io
import logging
import sys

import pytest

from imfvla.process.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_lines_have_a_beginning_count_and_time_left(caplog):
    with caplog.at_level(logging.INFO), Progress("sweep", 4, done=2) as bar:
        bar.advance()
        bar.advance("the last one")
    assert [record.getMessage().split("  ")[:2] for record in caplog.records] == [
        ["sweep: 2 of 4"],
        ["sweep: 4 of 4", "the last one"],
    ]
    assert caplog.records[1].getMessage().endswith(" s, 0 s left")


def test_a_bar_inside_of_another_shares_its_display_and_leaves_it(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with Progress("sweep", 2) as outer:
        for _ in range(2):
            with Progress("training", 3) as inner:
                inner.advance("loss 1")
                display = inner._bar
                assert display is outer._bar
                assert [task.description for task in display.tasks] == ["sweep", "training"]
            assert [task.description for task in display.tasks] == ["sweep"]
            outer.advance()
        assert display.tasks[0].completed == 2
    assert Progress._display is None


def test_a_bar_that_an_error_ends_is_left_too(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with pytest.raises(KeyboardInterrupt), Progress("sweep", 2), Progress("training", 3):
        raise KeyboardInterrupt
    assert Progress._display is None
