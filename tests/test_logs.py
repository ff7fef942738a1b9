"""What is logged: each cause once, to the run's own file, and without a change for whoever configured logging."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

import touchcell as tc
from touchcell.cell.cli.run import LOG
from touchcell.drivers.core.frame_monitor import FrameMonitor
from touchcell.logs import LOGGER, OncePerCause, log_to_file, log_to_terminal

logger = logging.getLogger("touchcell.tests")


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


def test_a_cause_is_warned_of_once_until_it_is_forgotten(caplog: pytest.LogCaptureFixture) -> None:
    once = OncePerCause(logger)
    for _ in range(3):
        once.warning("late", "late by %d", 1)
        once.warning("lost", "lost")
    assert warnings(caplog) == ["late by 1", "lost"]
    once.forget()
    once.warning("late", "late by %d", 2)
    assert warnings(caplog) == ["late by 1", "lost", "late by 2"]


def test_dropped_frames_are_logged_once_for_each_kind(caplog: pytest.LogCaptureFixture) -> None:
    monitor = FrameMonitor("tip")
    monitor.count_lost(0, overrun=False)
    for _ in range(2):
        monitor.count_lost(3, overrun=False)
        monitor.count_lost(2, overrun=True)
        monitor.count_bad("out_of_order")
    assert warnings(caplog) == [
        "tip: 3 frames were lost on their way",
        "tip: dropped 2 frames that were not read in time",
        "tip: dropped a bad frame (out of order)",
    ]
    monitor.reset_errors()
    monitor.count_bad("out_of_order")
    assert len(warnings(caplog)) == 4


def test_a_refused_command_is_logged_once_until_one_is_accepted(caplog: pytest.LogCaptureFixture) -> None:
    with tc.connect_arm("sim_arm", start_pose_mm_deg=[0, 0, 200, 180, 0, 0]) as arm, arm.control() as control:
        for twist in (np.full(6, np.nan), np.full(6, np.nan), np.zeros(6), np.full(6, np.nan)):
            with_refusal = pytest.raises(tc.CommandRejected) if np.isnan(twist).any() else None
            if with_refusal is None:
                control.send_twist(twist)
                continue
            with with_refusal:
                control.send_twist(twist)
    assert len(warnings(caplog)) == 2
    assert "non-finite" in warnings(caplog)[0]


def test_a_run_writes_its_log(tmp_path: Path) -> None:
    cell = tc.load_cell("surface_follow_sim", set={"interlocks.uncertain.limit_mm": 0.07})
    run = tc.run(cell, out=tmp_path / "run")
    assert run.outcome == "tripped"
    log = (run.folder / LOG).read_text()
    for line in (
        "INFO    touchcell.drivers.core.device: arm: active",
        "INFO    touchcell.tasks.state_machine: surface_following: prepare -> approach by ",
        "WARNING touchcell.control.latch: trip: uncertain: sensor: ",
        "INFO    touchcell.cell.cli.run: surface_follow_sim: tripped after ",
    ):
        assert line in log
    assert log.count("touchcell.control.latch") == 1


def test_a_log_file_changes_nothing_for_other_handlers(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    before = (logging.getLogger(LOGGER).level, logging.getLogger(LOGGER).handlers[:])
    with log_to_file(tmp_path / "a.log"):
        logger.info("for the file only")
        logger.warning("for both")
    logger.warning("for the others only")
    assert [record.getMessage() for record in caplog.records] == ["for both", "for the others only"]
    written = (tmp_path / "a.log").read_text()
    assert "for the file only" in written
    assert "for both" in written
    assert "for the others only" not in written
    assert (logging.getLogger(LOGGER).level, logging.getLogger(LOGGER).handlers) == before


def test_a_log_file_that_cannot_be_written_is_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with log_to_file(tmp_path / "none" / "a.log"):
        logger.warning("still logged")
    assert "cannot be written" in warnings(caplog)[0]
    assert warnings(caplog)[1] == "still logged"


def test_a_full_disk_ends_the_log_file_without_a_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    with log_to_file(Path("/dev/full")):
        for _ in range(3):
            logger.info("x" * 10_000)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(("verbosity", "lines"), [(0, 1), (1, 2), (2, 3), (5, 3)])
def test_the_terminal_shows_what_was_asked_for(
    verbosity: int, lines: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with log_to_terminal(verbosity), log_to_file(tmp_path / "a.log"):
        logger.debug("d")
        logger.info("i")
        logger.warning("w")
    assert len(capsys.readouterr().err.splitlines()) == lines
    assert "i" in (tmp_path / "a.log").read_text()


def test_the_library_configures_no_logging() -> None:
    assert logging.getLogger(LOGGER).handlers == []
    assert logging.getLogger(LOGGER).level == logging.NOTSET


def test_an_unexpected_exception_is_one_line_on_the_terminal_and_whole_in_the_log_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with log_to_terminal(0), log_to_file(tmp_path / "a.log"):
        try:
            raise ValueError("covariance")
        except ValueError as error:
            logging.getLogger("touchcell.cell").error("running: %s", error, exc_info=error)
    assert capsys.readouterr().err == "touchcell: ERROR: running: covariance\n"
    assert "Traceback" in (tmp_path / "a.log").read_text()
