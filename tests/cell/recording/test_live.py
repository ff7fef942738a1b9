"""Viewers on this machine get what is recorded, and one that reads nothing holds nothing up."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import pytest

from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.recorder import Recorder
from touchcell.errors import ConfigError

client = pytest.importorskip("websockets.sync.client", reason="pip install websockets")

SUBPROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")


def test_a_viewer_gets_the_messages_that_are_recorded(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap", wall_offset_ns=1_000) as recorder:
        recorder.write("/task", 1, {"state": "approach"})
        with (
            recorder.serve("cell", 0) as address,
            client.connect(address, subprotocols=[SUBPROTOCOL], open_timeout=10) as viewer,
        ):
            assert recorder.live
            channel = None
            while channel is None:
                told = json.loads(viewer.recv(timeout=10))
                if told["op"] == "advertise":
                    channel = next(each for each in told["channels"] if each["topic"] == "/task")
            assert channel["encoding"] == "protobuf"
            assert channel["schemaName"] == "touchcell.Task"
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 7, "channelId": channel["id"]}]}))
            # The subscription is handled in the server's own time.
            t_ns = 1
            answer: str | bytes = ""
            while not isinstance(answer, bytes):
                t_ns += 1
                recorder.write("/task", t_ns, {"state": "run"})
                try:
                    answer = viewer.recv(timeout=0.05)
                except TimeoutError:
                    continue
            opcode, _, stamp_ns = MESSAGE.unpack_from(answer)
            assert opcode == 1
            assert 1_000 < stamp_ns <= 1_000 + t_ns
            assert b"run" in answer
        assert not recorder.live
    assert len(list(read(tmp_path / "run.mcap"))) == t_ns


def test_a_viewer_that_reads_nothing_loses_messages_and_the_recording_none(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.write("/x", 0, {"pad": "p"})
        with recorder.serve("cell", 0) as address, client.connect(address, subprotocols=[SUBPROTOCOL]) as viewer:
            viewer.send(json.dumps({"op": "subscribe", "subscriptions": [{"id": 1, "channelId": 1}]}))
            for i in range(1, 20_000):
                recorder.write("/x", i, {"pad": "p" * 400})
    assert sum(1 for _ in read(tmp_path / "run.mcap")) == 20_000


def test_a_port_that_is_taken_is_a_clear_error(tmp_path: Path) -> None:
    with Recorder(tmp_path / "1.mcap") as first, first.serve("cell", 0) as address:
        port = int(address.rpartition(":")[2])
        with (
            Recorder(tmp_path / "2.mcap") as second,
            pytest.raises(ConfigError, match="cannot be served"),
            second.serve("other", port),
        ):
            pass
