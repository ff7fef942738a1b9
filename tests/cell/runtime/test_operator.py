"""A person stops a run by a key, by losing the terminal, by a signal, or from another shell."""

from __future__ import annotations

import contextlib
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from touchcell.cell.cli.exit_codes import EXIT_BAD_INPUT
from touchcell.cell.cli.main import main
from touchcell.cell.runtime.operator_input import (
    FolderInUse,
    NoSuchRun,
    ask_to_stop,
    await_end,
    reachable,
    running,
    stop_on_keys,
    stop_on_signals,
)
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "surface_follow_sim.yaml"
DEADLINE_S = 60.0

# A child process that leads a session with a terminal, as a shell would start it, and says how often it was asked.
PROGRAM = """
import fcntl, sys, termios
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.operator_input import stop_on_keys
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
stop = StopRequest()
before = termios.tcgetattr(0)
with stop_on_keys(stop) as look:
    print("ready", flush=True)
    while not stop.count:
        look()
print(stop.count, termios.tcgetattr(0) == before if sys.argv[1] == "check" else "", flush=True)
"""


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    ends = pty.openpty()
    yield ends
    for end in ends:
        with contextlib.suppress(OSError):
            os.close(end)


def child(slave: int, word: str) -> subprocess.Popen[str]:
    program = [sys.executable, "-c", PROGRAM, word]
    process = subprocess.Popen(program, stdin=slave, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize(("key", "count"), [(b" ", 2), (b"\x1b", 2), (b"\x1b[A", 2), (b"s", 1), (b"q", 1), (b"xyq", 1)])
def test_keys_stop_and_the_terminal_is_left_as_it_was(terminal: tuple[int, int], key: bytes, count: int) -> None:
    master, slave = terminal
    process = child(slave, "check")
    os.write(master, key)
    told, _ = process.communicate(timeout=DEADLINE_S)
    assert told == f"{count} True\n"


def test_a_lost_terminal_stops_at_once(terminal: tuple[int, int]) -> None:
    master, slave = terminal
    process = subprocess.Popen(
        [sys.executable, "-c", "import signal; signal.signal(signal.SIGHUP, signal.SIG_IGN)\n" + PROGRAM, "lost"],
        stdin=slave,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    os.close(slave)
    os.close(master)
    told, _ = process.communicate(timeout=DEADLINE_S)
    assert told == "2 \n"
    assert process.returncode == 0


def test_what_is_no_terminal_is_left_alone(tmp_path: Path) -> None:
    from touchcell.cell.runtime.stop_request import StopRequest

    stop = StopRequest()
    file = tmp_path / "keys"
    file.write_text("    qqq")
    with file.open() as stream, stop_on_keys(stop, stream) as look:
        look()
    assert stop.count == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_signals_ask_and_handlers_are_restored(number: signal.Signals) -> None:
    from touchcell.cell.runtime.stop_request import StopRequest

    stop = StopRequest()
    before = signal.getsignal(number)
    with stop_on_signals(stop):
        signal.raise_signal(number)
        signal.raise_signal(number)
    assert stop.count == 2
    assert signal.getsignal(number) is before


def test_a_number_left_by_a_crash_reaches_no_stranger(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "pid").write_text(str(os.getpid()))
    assert running(tmp_path) == []
    with pytest.raises(NoSuchRun):
        ask_to_stop(tmp_path / "run", at_once=True)


def test_a_run_is_found_as_long_as_it_lives(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    with reachable(folder):
        assert running(tmp_path) == [folder]
        with pytest.raises(FolderInUse), reachable(folder):
            pass
        assert (folder / "pid").read_text() == str(os.getpid())
        assert not await_end(folder, wait_s=0.0)
    assert running(tmp_path) == []
    assert await_end(folder)


def test_stop_without_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["stop"]) == EXIT_BAD_INPUT
    assert "no run is in progress" in capsys.readouterr().err


@pytest.mark.parametrize("now", [False, True])
def test_stop_from_another_shell(tmp_path: Path, now: bool, capsys: pytest.CaptureFixture[str]) -> None:
    data = yaml.safe_load(SHIPPED.read_text())
    data["sensors"]["sensor"]["estimator"] = {"kind": "true_contact"}
    data["task"]["approach_speed_mm_s"] = 0.001
    data["task"]["retract_mm"] = 1
    cell, folder = tmp_path / "cell.yaml", tmp_path / "run"
    cell.write_text(yaml.safe_dump(data))
    command = [sys.executable, "-m", "touchcell", "run", str(cell), "--out", str(folder), "--quiet"]
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True)
    deadline_s = time.monotonic() + DEADLINE_S
    # Handlers are in place once the loop writes.
    while not (folder / "run.mcap").exists() or (folder / "run.mcap").stat().st_size < 20_000:
        assert time.monotonic() < deadline_s
        assert process.poll() is None
        select.select([], [], [], 0.02)
    assert main(["stop", str(folder), *(["--now"] if now else [])]) == 0
    assert "stopped" in capsys.readouterr().out
    told, _ = process.communicate(timeout=DEADLINE_S)
    assert process.returncode == 0
    assert "surface_following stopped" in told
    assert ("at once by the operator" in told) == now
