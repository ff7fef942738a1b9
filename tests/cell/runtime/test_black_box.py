"""The black box of a run is there whatever ended the run, and ``touchcell why`` reads it."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.unforeseen import sway
from touchcell.cell.cli.exit_codes import EXIT_OK, EXIT_TASK_FAILED
from touchcell.cell.cli.main import main
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording import mcap
from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.message_types import Encoder
from touchcell.cell.recording.messages import declared_type
from touchcell.cell.recording.ring import RingWriter, read_ring
from touchcell.cell.runtime.black_box import ABOUT, CRASH, MESSAGES, RING, BlackBox, read_left_ring
from touchcell.paths import CONFIGS

ENCODER = Encoder(declared_type)

DIE_AT = 900


def true_contact_cell(folder: Path, **changes: Any) -> Path:
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    put_on_true_contact(data)
    data |= changes
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def numbers(messages: list[mcap.Message]) -> list[int]:
    return [message.data["k"] for message in messages]


def test_a_ring_returns_what_was_added_in_order(tmp_path: Path) -> None:
    ring = RingWriter(tmp_path / "ring", 1 << 20, {"cell": "x"})
    for k in range(500):
        ring.add([("/task", k - 5, ENCODER.encode("/task", {"k": k}))])
    ring.close()
    about, messages = read_ring(tmp_path / "ring")
    assert about == {"cell": "x"}
    assert numbers(messages) == list(range(500))
    assert (messages[0].topic, messages[0].t_ns) == ("/task", -5)


@given(
    lengths=st.lists(st.integers(0, 15_000) | st.integers(17_000, 20_000), min_size=1, max_size=200),
    together=st.integers(1, 7),
)
def test_a_ring_that_is_full_keeps_the_newest_without_a_gap(lengths: list[int], together: int) -> None:
    ring = RingWriter(None, 0, {})
    added = [("/x", k, ENCODER.encode("/x", {"k": k, "pad": "p" * length})) for k, length in enumerate(lengths)]
    for first in range(0, len(added), together):
        ring.add(added[first : first + together])
    kept = numbers(ring.messages())
    ring.close()
    fitting = [k for k, length in enumerate(lengths) if length < 16_000]
    assert kept == fitting[len(fitting) - len(kept) :]
    size = sum(lengths[k] + 60 for k in fitting)
    assert len(kept) == len(fitting) or sum(lengths[k] + 60 for k in kept) > 100_000
    assert size < 200_000 or kept


def test_the_file_of_a_ring_never_grows(tmp_path: Path) -> None:
    ring = RingWriter(tmp_path / "ring", 1 << 20, {})
    before = os.stat(tmp_path / "ring")
    assert before.st_blocks * 512 >= 1 << 20
    for k in range(20_000):
        ring.add([("/x", k, ENCODER.encode("/x", {"k": k, "pad": "p" * 100}))])
    ring.close()
    after = os.stat(tmp_path / "ring")
    assert (after.st_size, after.st_blocks) == (before.st_size, before.st_blocks)
    assert numbers(read_ring(tmp_path / "ring")[1])[-1] == 19_999


@given(data=st.data())
def test_damage_to_a_ring_loses_messages_and_invents_none(data: st.DataObject) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "ring"
        ring = RingWriter(path, 0, {"cell": "x"})
        for k in range(3000):
            ring.add([("/x", k, ENCODER.encode("/x", {"k": k}))])
        ring.close()
        content = bytearray(path.read_bytes())
        for at in data.draw(st.lists(st.integers(0, len(content) - 1), min_size=1, max_size=20)):
            content[at] ^= data.draw(st.integers(1, 255))
        del content[data.draw(st.integers(0, len(content))) :]
        path.write_bytes(content)
        try:
            found = numbers(read_ring(path)[1])
        except RecordingError:
            return
        assert found == sorted(set(found) & set(range(3000)))


def test_a_disk_without_room_for_a_ring_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(RecordingError, match="No space left"):
        BlackBox(tmp_path)


def test_a_ring_whose_disk_fails_raises_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ring = RingWriter(tmp_path / "ring", 0, {})
    ring.add([("/x", 0, ENCODER.encode("/x", {}))])

    def broken(*_: Any) -> int:
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr(os, "pwrite", broken)
    ring.add([("/x", 1, ENCODER.encode("/x", {}))])
    assert ring.failed
    assert len(ring.messages()) == 1
    ring.close()


@pytest.mark.parametrize(("name", "words"), [("SIGKILL", ""), ("SIGSEGV", "Segmentation fault"), ("SIGABRT", "Abort")])
def test_a_run_that_is_killed_leaves_a_black_box_that_why_reads(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, words: str
) -> None:
    cell, out = true_contact_cell(tmp_path), tmp_path / "run"
    command = [sys.executable, "-m", "tests.helpers.dying_run", str(DIE_AT), name, str(cell), str(out)]
    dead = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert dead.returncode < 0, dead.stderr
    about, messages = read_left_ring(out)
    assert DIE_AT <= len(messages) < DIE_AT + 20
    assert about["cell"] == "surface_follow_sim"
    assert "outcome" not in about
    assert main(["why", str(out)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "ended without a result: it was killed, crashed, or there was no memory left" in told
    assert "arm: moved" in told
    assert words in told
    assert ((out / CRASH).stat().st_size > 0) == bool(words)
    assert (out / "why.png").stat().st_size > 10_000


def test_a_run_that_ends_by_itself_leaves_no_ring(tmp_path: Path) -> None:
    assert main(["run", str(true_contact_cell(tmp_path)), "--out", str(tmp_path / "run"), "--quiet"]) == EXIT_OK
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert not left & {RING, MESSAGES, ABOUT, CRASH}


def test_a_disk_that_fills_up_leaves_the_recording_the_black_box_and_a_result(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    room = 60_000
    write = os.write

    def limited(fd: int, data: Any) -> int:
        nonlocal room
        if len(data) > room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        room -= len(data)
        return write(fd, data)

    monkeypatch.setattr(os, "write", limited)
    out = tmp_path / "run"
    assert main(["run", str(true_contact_cell(tmp_path)), "--out", str(out), "--quiet"]) != EXIT_OK
    assert json.loads((out / "result.json").read_text())["outcome"] == "error"
    damage: list[mcap.Damage] = []
    assert len(list(read(out / "run.mcap", damage))) > 200
    assert "cut off" in str(damage[-1])
    about, messages = read_left_ring(out)
    assert about["outcome"] == "error"
    assert "No space left" in about["reason"]
    assert len(messages) > 200
    capsys.readouterr()
    assert main(["why", str(out)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "No space left" in told
    assert "evidence: blackbox.ring" in told


def test_a_failed_run_is_explained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    cell = true_contact_cell(tmp_path)
    data = yaml.safe_load(cell.read_text())
    sway(data)["arms"]["arm"]["start_pose_mm_deg"] = [-80, 0, 120, 180, 0, 0]
    cell.write_text(yaml.safe_dump(data))
    out = tmp_path / "run"
    assert main(["run", str(cell), "--out", str(out), "--quiet"]) == EXIT_TASK_FAILED
    assert f"touchcell why {out}" in capsys.readouterr().out
    assert main(["why", str(out)]) == EXIT_OK
    told = capsys.readouterr().out
    assert "none within 50 mm" in told
    assert "evidence: blackbox.mcap" in told


def test_a_run_that_is_done_needs_no_explanation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    assert main(["run", str(true_contact_cell(tmp_path)), "--out", str(out), "--quiet"]) == EXIT_OK
    assert main(["why", str(out)]) == EXIT_OK
    assert "there is nothing to explain" in capsys.readouterr().out
