"""Shared-memory blocks: no interleaving of writer and reader returns a torn record."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.core.errors import CodecError, CorruptMessage
from touchcell.drivers.hosting import memory
from touchcell.drivers.hosting.memory import SLOTS, BlockMismatch, BlockReader, BlockWriter, create

LAYOUT = 7


@pytest.fixture
def fd() -> Iterator[int]:
    fd = create("test", LAYOUT, 64)
    yield fd
    os.close(fd)


def test_records_are_read_as_they_were_written(fd: int) -> None:
    with BlockWriter(fd, LAYOUT) as writer, BlockReader(fd, LAYOUT) as reader:
        assert reader.read() is None
        for number, record in enumerate([b"", b"a", bytes(range(64)), b"shorter"] * 3, start=1):
            assert writer.write(record) == number == reader.newest
            assert reader.read() == (number, record)
        with pytest.raises(CodecError, match="longer"):
            writer.write(bytes(65))


def test_another_layout_is_refused(fd: int) -> None:
    with pytest.raises(BlockMismatch) as caught:
        BlockReader(fd, LAYOUT + 1)
    assert caught.value.field == "layout"
    plain = os.memfd_create("plain")
    os.ftruncate(plain, 4096)
    with pytest.raises(BlockMismatch) as caught:
        BlockWriter(plain, 0)
    assert caught.value.field == "magic"
    os.close(plain)


def test_a_reader_cannot_write_and_the_memory_cannot_be_truncated(fd: int) -> None:
    with BlockReader(fd, LAYOUT) as reader, pytest.raises(TypeError):
        reader._bytes[0] = 1
    with pytest.raises(PermissionError):
        os.ftruncate(fd, 8)


class _Traced:
    """Stops a block's method at each of its lines and lets the test act there."""

    def __init__(self, at_line: Any) -> None:
        self._at_line = at_line

    def __call__(self, frame: Any, event: str, _: Any) -> Any:
        if frame.f_code.co_filename != memory.__file__:
            return None
        if event == "line":
            sys.settrace(None)
            self._at_line()
            sys.settrace(self)
        return self


def _images(records: list[bytes]) -> list[bytes]:
    """The memory after each line of the writer, and halfway through each copy."""
    fd = create("test", LAYOUT, 64)
    size = os.fstat(fd).st_size
    images: list[bytes] = []
    with mmap.mmap(fd, size) as memory_map, BlockWriter(fd, LAYOUT) as writer:

        def copy_image() -> None:
            image = bytes(memory_map)
            if images and images[-1] != image:
                changed = [k for k in range(size) if image[k] != images[-1][k]]
                half = changed[len(changed) // 2]
                if len(changed) > 8:
                    images.append(image[:half] + images[-1][half:])
                    images.append(images[-2][:half] + image[half:])
            images.append(image)

        for record in records:
            sys.settrace(_Traced(copy_image))
            try:
                writer.write(record)
            finally:
                sys.settrace(None)
            copy_image()
    os.close(fd)
    return images


@given(
    fills=st.lists(st.integers(1, 255), min_size=1, max_size=12, unique=True),
    steps=st.lists(st.integers(0, 60), min_size=1, max_size=40),
    length=st.integers(9, 64),
)
@settings(max_examples=60)
def test_no_interleaving_tears_a_record(fills: list[int], steps: list[int], length: int) -> None:
    """The writer continues by a drawn number of steps at each line of the reader."""
    records = [bytes([fill]) * length for fill in fills]
    images = _images(records)
    fd = create("test", LAYOUT, 64)
    at, step = 0, 0
    with mmap.mmap(fd, os.fstat(fd).st_size) as memory_map, BlockReader(fd, LAYOUT) as reader:

        def write_on() -> None:
            nonlocal at, step
            at = min(at + steps[step % len(steps)], len(images) - 1)
            step += 1
            memory_map[:] = images[at]

        newest = 0
        for _ in range(len(fills) + 2):
            sys.settrace(_Traced(write_on))
            try:
                read = reader.read()
            except CorruptMessage:
                continue
            finally:
                sys.settrace(None)
            if read is not None:
                number, record = read
                assert record == records[number - 1]
                assert number >= newest
                newest = number
    os.close(fd)


@given(after=st.integers(0, 200), count=st.integers(SLOTS, 3 * SLOTS))
@settings(max_examples=60)
def test_a_writer_that_dies_leaves_its_last_complete_record(after: int, count: int) -> None:
    records = [bytes([k]) * 32 for k in range(1, count + 1)]
    images = _images(records)
    image = images[min(after, len(images) - 1)]
    fd = create("test", LAYOUT, 64)
    with mmap.mmap(fd, os.fstat(fd).st_size) as memory_map, BlockReader(fd, LAYOUT) as reader:
        memory_map[:] = image
        read = reader.read()
        if read is not None:
            assert read[1] == records[read[0] - 1]
        else:
            assert reader.newest == 0
    os.close(fd)


def test_a_real_writer_is_never_read_torn() -> None:
    """A process that writes as fast as it can, and is killed while it does."""
    fd = create("test", LAYOUT, 4096)
    script = (
        "import sys; from touchcell.drivers.hosting.memory import BlockWriter\n"
        f"writer = BlockWriter(int(sys.argv[1]), {LAYOUT})\n"
        "k = 0\n"
        "while True: k += 1; writer.write(bytes([k % 256]) * 4096)\n"
    )
    with BlockReader(fd, LAYOUT) as reader:
        child = subprocess.Popen([sys.executable, "-c", script, str(fd)], pass_fds=[fd])
        try:
            numbers = set()
            while len(numbers) < 100:
                read = reader.read()
                if read is not None:
                    assert read[1] == bytes([read[0] % 256]) * 4096
                    numbers.add(read[0])
        finally:
            child.kill()
            child.wait()
        number, record = reader.read() or (0, b"")
        assert number >= max(numbers)
        assert record == bytes([number % 256]) * 4096
    os.close(fd)
