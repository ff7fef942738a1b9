"""Recordings are complete, readable after a kill, and fail safely on a full disk."""

from __future__ import annotations

import errno
import io
import json
import os
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from tests.fault_injection.fuzz_recordings import lz4_bomb, original, try_mutants
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Damage, follow, read
from touchcell.cell.recording.recorder import CHUNK_BYTES, MOST_OPEN, Recorder


def test_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for i in range(1000):
            recorder.write("/arm/tcp", i, {"i": i, "pose": np.eye(4) * i})
            recorder.write("/task", i, {"state": "run"})
    messages = list(read(path))
    assert len(messages) == 2000
    assert [m.data["i"] for m in messages if m.topic == "/arm/tcp"] == list(range(1000))
    assert messages[-2].data["pose"][3][3] == 999.0


def test_non_finite_numbers_become_null(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write("/x", 0, {"a": float("nan"), "b": np.array([1.0, np.inf]), "c": np.float64("-inf")})
    (message,) = read(tmp_path / "run.mcap")
    assert message.data == {"a": None, "b": [1.0, None], "c": None}


@pytest.mark.parametrize("padding", [0, 80, 1000])
def test_kill_minus_nine_loses_fewer_than_200_messages(tmp_path: Path, padding: int) -> None:
    path = tmp_path / "run.mcap"
    program = (
        "import os, signal, pathlib\n"
        "from touchcell.cell.recording.recorder import Recorder\n"
        f"recorder = Recorder(pathlib.Path({str(path)!r}))\n"
        "for i in range(2000):\n"
        f"    recorder.write('/x', i, {{'i': i, 'pad': 'p' * {padding}}})\n"
        "os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", program], check=False)
    numbers = [message.data["i"] for message in read(path)]
    assert numbers == list(range(len(numbers)))
    assert 2000 - MOST_OPEN <= len(numbers) < 2000
    assert MOST_OPEN < 200


def test_a_cycle_is_handed_over_whole_and_a_slow_cell_in_time_for_those_who_follow(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        for i in range(8):
            recorder.write("/x", i * 100_000_000, {"i": i})
        # Whoever reads the file now is at most a quarter of a second behind.
        assert [message.data["i"] for message in read(path)][-1] >= 5


def test_a_file_cut_anywhere_is_readable_up_to_the_cut(tmp_path: Path) -> None:
    whole = tmp_path / "whole.mcap"
    with Recorder(whole) as recorder:
        for i in range(1500):
            recorder.write("/x", i, {"i": i, "noise": os.urandom(20).hex()})
    content = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    counts = []
    for fraction in (0.1, 0.37, 0.5, 0.77, 0.99):
        cut.write_bytes(content[: int(len(content) * fraction)])
        numbers = [message.data["i"] for message in read(cut)]
        assert numbers == list(range(len(numbers)))
        counts.append(len(numbers))
    assert counts == sorted(counts)
    assert counts[2] > 300


class _FullDisk(io.BytesIO):
    """Raises beyond a size, as a full disk does."""

    def write(self, data: object) -> int:
        if self.tell() > 40_000:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return super().write(data)  # type: ignore[arg-type]

    def close(self) -> None:
        """Keep what was written, to be read by the test."""


def test_full_disk_is_a_typed_error_and_keeps_what_was_written(tmp_path: Path) -> None:
    disk = _FullDisk()
    recorder = Recorder(tmp_path / "run.mcap", stream=disk)

    def write_for_ever() -> None:
        for i in range(100_000):
            recorder.write("/x", i, {"i": i, "noise": os.urandom(40).hex()})

    with pytest.raises(RecordingError) as caught:
        write_for_ever()
    assert "No space left" in str(caught.value)
    recorder.close()
    path = tmp_path / "kept.mcap"
    path.write_bytes(disk.getvalue())
    assert len(list(read(path))) > 100


def test_refuses_files_that_are_not_recordings(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"something else")
    with pytest.raises(RecordingError, match="not an MCAP"):
        list(read(tmp_path / "x"))
    with pytest.raises(RecordingError, match="cannot be read"):
        list(read(tmp_path / "missing"))


def damaged(path: Path) -> tuple[list[int], list[Damage]]:
    """Numbers of the messages that are read, and what is named as damaged."""
    damage: list[Damage] = []
    return [message.data["i"] for message in read(path, damage)], damage


def test_a_flipped_bit_is_never_read_as_another_value(tmp_path: Path) -> None:
    whole = original()
    path = tmp_path / "run.mcap"
    path.write_bytes(whole)
    numbers, none = damaged(path)
    assert none == []
    for at in range(100, len(whole) // 2, len(whole) // 40):
        rotten = bytearray(whole)
        rotten[at] ^= 0x10
        path.write_bytes(rotten)
        kept, named = damaged(path)
        assert set(kept) <= set(numbers)
        assert len(kept) >= 0.6 * len(numbers)
        assert len(kept) == len(numbers) or named


def test_channels_are_found_at_the_end_when_the_chunk_that_describes_them_is_damaged(tmp_path: Path) -> None:
    rotten = bytearray(original())
    rotten[200] ^= 0xFF
    path = tmp_path / "run.mcap"
    path.write_bytes(rotten)
    kept, (first, *_) = damaged(path)
    assert len(kept) > 100
    assert "checksum" in first.reason or "decompressed" in first.reason


def test_the_next_chunk_is_found_behind_a_damaged_length(tmp_path: Path) -> None:
    whole = original()
    at = whole.index(b"\x04\x00\x00\x00zstd", len(whole) // 4) - 32
    rotten = bytearray(whole)
    rotten[at] = 0xFF
    path = tmp_path / "run.mcap"
    path.write_bytes(rotten)
    kept, (first, *_) = damaged(path)
    assert "bytes are damaged" in first.reason
    assert kept[-1] == 999


def test_a_cut_recording_says_so(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(original()[:-5000])
    assert "cut off" in damaged(path)[1][-1].reason


def test_a_chunk_that_would_fill_the_memory_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.mcap"
    path.write_bytes(lz4_bomb(megabytes=300))
    damage: list[Damage] = []
    assert list(read(path, damage)) == []
    assert "claims to hold" in damage[0].reason
    assert list(follow(path, lambda: False)) == []


def test_no_mutant_of_a_recording_raises_anything_else_or_is_read_as_something_else(tmp_path: Path) -> None:
    assert [tried for tried in try_mutants(150, seed=3, folder=tmp_path) if tried.problem] == []


def test_a_length_beyond_all_memory_is_damage(tmp_path: Path) -> None:
    whole = original()
    # The length of the data of a chunk, behind the name of its compression.
    at = whole.index(b"\x04\x00\x00\x00zstd", len(whole) // 2) + 8
    path = tmp_path / "run.mcap"
    path.write_bytes(whole[:at] + struct.pack("<Q", 2**64 - 1) + whole[at + 8 :])
    kept, named = damaged(path)
    assert named
    assert kept[-1] == 999


def test_the_schema_of_a_channel_has_a_typed_field_for_every_key(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.write("/a/b", 1, {"x_mm": 1.5, "on": True, "name": "n", "gone": float("nan"), "twist": [None, 2.0]})
        recorder.write("/a/b", 2, {"x_mm": 2.5})
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (schema,) = summary.schemas.values()
    assert (schema.name, schema.encoding) == ("touchcell.AB", "protobuf")
    (file,) = FileDescriptorSet.FromString(schema.data).file
    (message,) = file.message_type
    kinds = {field.name: (field.type, field.label == field.LABEL_REPEATED) for field in message.field}
    assert kinds == {
        "x_mm": (FieldDescriptorProto.TYPE_DOUBLE, False),
        "on": (FieldDescriptorProto.TYPE_BOOL, False),
        "name": (FieldDescriptorProto.TYPE_STRING, False),
        "gone": (FieldDescriptorProto.TYPE_DOUBLE, False),
        "twist": (FieldDescriptorProto.TYPE_DOUBLE, True),
    }


def test_fields_that_come_later_keep_the_numbers_of_those_before_them(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path) as recorder:
        recorder.write("/task", 1, {"state": "approach"})
        recorder.write("/task", 2, {"state": "run", "error_z_mm": 1, "a.b": {"c": [1, [2.5]]}})
        recorder.write("/task", 3, {"state": "run", "error_z_mm": 0.5})
        recorder.write("/task", 4, {"state": "done"})
    messages = list(read(path))
    assert [message.data for message in messages] == [
        {"state": "approach"},
        {"state": "run", "error_z_mm": 1, "a.b": {"c": [1, [2.5]]}},
        {"state": "run", "error_z_mm": 0.5},
        {"state": "done"},
    ]
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    numbers = [
        {field.name: field.number for field in FileDescriptorSet.FromString(schema.data).file[-1].message_type[0].field}
        for _, schema in sorted(summary.schemas.items())
    ]
    assert numbers[0] == {"state": 1}
    assert all(later.items() >= numbers[0].items() for later in numbers)


def test_stamps_are_of_the_wall_clock_for_viewers_and_of_the_cells_clock_for_us(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with Recorder(path, wall_offset_ns=1_700_000_000_000_000_000) as recorder:
        recorder.write("/x", 5, {"i": 1})
    assert [message.t_ns for message in read(path)] == [5]
    with path.open("rb") as stream:
        assert [message.log_time for _, _, message in make_reader(stream).iter_messages()] == [
            1_700_000_000_000_000_005
        ]


def test_recordings_of_earlier_versions_are_read(tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        writer.start(profile="", library="touchcell")
        schema = writer.register_schema("task", "jsonschema", b'{"type":"object"}')
        channel = writer.register_channel("/task", "json", schema)
        for i in range(100):
            writer.add_message(channel, i, json.dumps({"state": "run", "gone": None, "twist": [1, 2.5]}).encode(), i)
        writer.finish()
    damage: list[Damage] = []
    messages = list(read(path, damage))
    assert damage == []
    assert [message.t_ns for message in messages] == list(range(100))
    assert messages[0].data == {"state": "run", "gone": None, "twist": [1, 2.5]}
