"""Recordings damaged at random: what is read is what was written, the rest is named, and nothing else is raised.

``python -m benchmarks fuzz-recordings [NUMBER [SEED]]`` tries 2000.
"""

from __future__ import annotations

import json
import random
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import lz4.frame
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk

from touchcell.cell.analysis.report import summarise
from touchcell.cell.analysis.run_data import load_run
from touchcell.cell.errors import RecordingError
from touchcell.cell.recording.mcap import Damage, follow, read
from touchcell.cell.recording.recorder import Recorder

_MESSAGES = 1000
_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class Tried:
    """What became of one mutant: how many messages were read, and what was wrong with the answer, if anything."""

    content: bytes
    messages: int
    named: bool
    problem: str
    time_s: float


def original() -> bytes:
    """A recording of 1000 numbered messages of the usual topics in about 20 chunks."""
    disk = _Kept()
    chance = random.Random(1)
    with Recorder(Path("original.mcap"), stream=disk) as recorder:
        for i in range(_MESSAGES):
            topic = ("/arms/arm/tcp", "/sensors/sensor/contact", "/sensors/sensor/truth", "/task", "/events")[i % 5]
            pose = {name: chance.gauss(0, 100) for name in ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg")}
            more = {"state": "run", "t_frame_ns": i, "gamma_deg": 0.0, "limited_by": [], "reason": "none"}
            recorder.write(topic, i * 2_000_000, {"i": i, **pose, **more})
    return disk.getvalue()


def lz4_bomb(megabytes: int) -> bytes:
    """A recording of one chunk that unpacks to ``megabytes`` of nothing."""
    size = megabytes << 20
    data = lz4.frame.compress(bytes(size), compression_level=0)
    builder = RecordBuilder()
    Chunk("lz4", data, 0, 0, 0, size).write(builder)
    return _MAGIC + bytes(builder.end())


def mutants(seed: int) -> Iterator[bytes]:
    """The original, damaged, for ever."""
    chance, whole = random.Random(seed), original()
    while True:
        content = bytearray(whole)
        for _ in range(chance.choice((1, 1, 2, 5, 50))):
            at, length = chance.randrange(8, len(content)), chance.choice((1, 4, 100, 5000))
            kind = chance.randrange(7)
            if kind <= 1:
                content[at] ^= 1 << chance.randrange(8)
            elif kind == 2:
                content[at : at + length] = bytes(len(content[at : at + length]))
            elif kind == 3:
                content[at : at + length] = chance.randbytes(len(content[at : at + length]))
            elif kind == 4:
                del content[at : at + length]
            elif kind == 5:
                content[at:at] = content[at - length : at]
            elif len(content) > 1000 and chance.random() < 0.3:
                del content[at:]
            if len(content) < 100:
                break
        yield bytes(content)


def try_mutants(number: int, seed: int, folder: Path) -> Iterator[Tried]:
    """Read ``number`` mutants in each way in which recordings are read."""
    path = folder / "mutant.mcap"
    path.write_bytes(original())
    written = {_line(message.topic, message.t_ns, message.data) for message in read(path)}
    assert len(written) == _MESSAGES
    for _, content in zip(range(number), mutants(seed), strict=False):
        path.write_bytes(content)
        started_s = time.perf_counter()
        damage: list[Damage] = []
        problem, messages = "", 0
        try:
            found = [_line(message.topic, message.t_ns, message.data) for message in read(path, damage)]
            messages = len(found)
            if set(found) - written:
                problem = "read what was never written"
            elif len(set(found)) < _MESSAGES and not damage:
                problem = f"{_MESSAGES - len(set(found))} messages are missing and nothing is named"
            summarise(load_run(path))
            sum(1 for _ in follow(path, lambda: False))
        except RecordingError:
            pass
        except Exception as error:
            problem = f"{type(error).__name__}: {error}"
        yield Tried(content, messages, bool(damage), problem, time.perf_counter() - started_s)


def run(arguments: Sequence[str], out: Path) -> None:
    """Try many, print the counts and the slowest, and keep what was not answered rightly."""
    number, seed = (int(arguments[0]) if arguments else 2000), (int(arguments[1]) if len(arguments) > 1 else 0)
    kept, slowest_s, counts = 0, 0.0, Counter[str]()
    with tempfile.TemporaryDirectory() as folder:
        for k, tried in enumerate(try_mutants(number, seed, Path(folder))):
            counts["wrong" if tried.problem else "damage named" if tried.named else "nothing lost"] += 1
            kept += tried.messages
            slowest_s = max(slowest_s, tried.time_s)
            if tried.problem:
                (out / f"recording_{seed}_{k}.mcap").write_bytes(tried.content)
                print(f"{k}: {tried.problem[:200]}")
    print(f"{number} recordings, seed {seed}: " + ", ".join(f"{count} {what}" for what, count in counts.most_common()))
    print(f"{100 * kept / (number * _MESSAGES):.1f} % of all messages read; slowest {slowest_s:.3f} s")
    started_s = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        bomb = Path(folder) / "bomb.mcap"
        bomb.write_bytes(lz4_bomb(megabytes=250))
        size = bomb.stat().st_size
        messages = sum(1 for _ in read(bomb, []))
    print(f"LZ4 bomb of {size / 1e6:.1f} MB: {messages} messages, {time.perf_counter() - started_s:.2f} s")


def _line(topic: str, t_ns: int, data: dict[str, object]) -> str:
    return json.dumps([topic, t_ns, data])


class _Kept(BytesIO):
    """Stays readable after the recorder has closed it."""

    def close(self) -> None:
        """Keep what was written."""
