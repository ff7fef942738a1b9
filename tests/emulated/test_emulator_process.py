"""An emulator follows its control channel, and never outlives its parent process."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from touchcell.drivers.core.errors import ConnectError
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import read_fault_script
from touchcell.testing.emulation.process import EmulatorProcess


def test_control_channel_begins_and_ends_faults_and_refuses_unknown_ones() -> None:
    with EmulatorProcess("ur", "--host", "127.77.0.1") as emulator:
        assert "pause" in str(emulator.fault("pause")) or emulator.state()
        emulator.clear("pause")
        with pytest.raises(ConnectError, match="unknown fault"):
            emulator.fault("no_such_fault")


def test_a_started_emulator_is_not_started_twice() -> None:
    emulator = EmulatorProcess("ur", "--host", "127.77.0.3").start()
    pid = emulator.pid
    with emulator as same:
        assert same.pid == pid
    assert not _alive(pid)


def test_an_emulator_dies_with_its_parent(tmp_path: Path) -> None:
    program = (
        "import os, signal\n"
        "from touchcell.testing.emulation.process import EmulatorProcess\n"
        "emulator = EmulatorProcess('ur', '--host', '127.77.0.2').start()\n"
        "print(emulator.pid, flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    parent = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert parent.returncode == -signal.SIGKILL
    pid = int(parent.stdout)
    deadline = time.monotonic() + 10.0
    while _alive(pid):
        assert time.monotonic() < deadline, "the emulator outlived its parent"
        time.sleep(0.01)


def _alive(pid: int) -> bool:
    try:
        # A zombie has ended; in a container it may not be reaped.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_an_emulator_that_cannot_start_reports_the_reason() -> None:
    with pytest.raises(ConnectError, match="did not start"):
        EmulatorProcess("ur", "--no-such-option").start()


def test_fault_script_is_sorted_and_checked(tmp_path: Path) -> None:
    script = tmp_path / "faults.yaml"
    script.write_text("- {at_s: 2.0, clear: drop}\n- {at_s: 1.2, fault: drop, value: 3}\n")
    events = read_fault_script(script)
    assert [(event.at_s, event.fault, event.value, event.clear) for event in events] == [
        (1.2, "drop", 3, False),
        (2.0, "drop", True, True),
    ]
    script.write_text("- {fault: drop}\n")
    with pytest.raises(ConfigError) as caught:
        read_fault_script(script)
    assert caught.value.key == "[1]"
    assert os.fspath(script) == caught.value.file
