"""Progress is a bar on a terminal, a line now and then elsewhere, and nothing for callers that are no command line."""

from __future__ import annotations

import io
import sys

import pytest

from touchcell.progress import LINE_PERIOD_S, ProgressLines, shown_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_line_is_written_once_in_each_period() -> None:
    now_s = 0.0
    stream = io.StringIO()
    lines = ProgressLines(stream, lambda: now_s)
    for step in range(7):
        now_s = step * LINE_PERIOD_S / 2
        lines("images", step, 6, f"image {step}")
    assert stream.getvalue().splitlines() == [f"images: {k} of 6, image {k}" for k in (2, 4, 6)]


def test_a_terminal_has_a_bar_for_each_work(monkeypatch: pytest.MonkeyPatch) -> None:
    stream = Terminal()
    monkeypatch.setattr(sys, "stdout", stream)
    with shown_progress() as show:
        for done in range(4):
            show("images", done, 3)
        show("epochs", 1, 2, "loss 0.5")
    assert "images" in stream.getvalue()
    assert "epochs: loss 0.5" in stream.getvalue()


def test_nothing_is_shown_to_callers_that_are_no_command_line(capsys: pytest.CaptureFixture[str]) -> None:
    with shown_progress(live=False) as show:
        show("images", 3, 3)
    assert capsys.readouterr().out == ""


def test_a_pipe_gets_no_bar(capsys: pytest.CaptureFixture[str]) -> None:
    assert not sys.stdout.isatty()
    with shown_progress() as show:
        show("images", 3, 3)
    assert capsys.readouterr().out == ""
