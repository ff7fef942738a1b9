"""Blocks of shared memory with one writer and many readers, unnamed and lock-free.

A block is a ring of numbered slots behind a header. The writer fills the slot after the newest and then publishes its
number; it never waits. A reader copies the newest slot and accepts the copy only if number and checksum still match, so
a torn record is never returned, whatever the processor's memory order, and a writer that was killed halfway through a
record leaves the last complete one readable. (A sequence lock for each slot: Lameter, "Effective synchronization on
Linux/NUMA systems", 2005, with several slots so that a dead writer blocks no reader.)
"""

from __future__ import annotations

import fcntl
import mmap
import os
import zlib
from types import TracebackType
from typing import Final, Self

from touchcell.drivers.core.errors import CodecError, CorruptMessage

MAGIC: Final = int.from_bytes(b"tchcell1", "little")
SLOTS: Final = 4
"""A reader is overtaken only if it is interrupted in a copy for as long as the writer needs for this many records."""

_WORD = 8
_HEADER_WORDS = 4
_MAGIC_AT, _LAYOUT_AT, _CAPACITY_AT, _NEWEST_AT = range(_HEADER_WORDS)
_SLOT_WORDS = 2
_NUMBER, _CHECK = range(_SLOT_WORDS)
_ATTEMPTS = 64


class BlockMismatch(CodecError):
    """The memory is not a block of the expected layout: two versions of the program are mixed."""


def create(name: str, layout: int, capacity: int) -> int:
    """Create a block of shared memory; return its file descriptor, which children may inherit.

    Args:
        name: name shown in /proc; need not be unique.
        layout: layout number on which writer and readers agree.
        capacity: bytes of the longest record.
    """
    stride = -(-capacity // _WORD) + _SLOT_WORDS
    size = _WORD * (_HEADER_WORDS + SLOTS * stride)
    fd = os.memfd_create(f"touchcell-{name}", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.ftruncate(fd, size)
    # Sealed, so that the memory cannot be truncated while it is mapped.
    fcntl.fcntl(fd, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK | fcntl.F_SEAL_GROW | fcntl.F_SEAL_SEAL)
    with mmap.mmap(fd, size) as memory:
        words = memoryview(memory).cast("Q")
        words[_LAYOUT_AT], words[_CAPACITY_AT], words[_MAGIC_AT] = layout, capacity, MAGIC
        words.release()
    return fd


class _Mapped:
    """A block mapped into this process; the descriptor may be closed afterwards."""

    def __init__(self, fd: int, layout: int, *, writable: bool) -> None:
        size = os.fstat(fd).st_size
        protection = mmap.PROT_READ | (mmap.PROT_WRITE if writable else 0)
        if size < _WORD * _HEADER_WORDS:
            raise BlockMismatch("size", size, "is too small for a block")
        self._map = mmap.mmap(fd, size, prot=protection)
        self._bytes = memoryview(self._map)
        self._words = self._bytes.cast("Q")
        for at, field, wanted in ((_MAGIC_AT, "magic", MAGIC), (_LAYOUT_AT, "layout", layout)):
            if (found := self._words[at]) != wanted:
                self.close()
                raise BlockMismatch(field, found, f"is not {wanted}")
        self.capacity = self._words[_CAPACITY_AT]
        self._stride = -(-self.capacity // _WORD) + _SLOT_WORDS

    def _slot(self, number: int) -> int:
        """Return the index of the first 64-bit entry of the slot of record ``number``."""
        return _HEADER_WORDS + (number % SLOTS) * self._stride

    def close(self) -> None:
        """Unmap the memory."""
        self._words.release()
        self._bytes.release()
        self._map.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class BlockWriter(_Mapped):
    """Writer of a block; each block has one.

    Raises:
        BlockMismatch: the memory behind ``fd`` is not a block of this ``layout``.
    """

    def __init__(self, fd: int, layout: int) -> None:
        super().__init__(fd, layout, writable=True)

    def write(self, record: bytes) -> int:
        """Publish ``record``, at most ``capacity`` bytes; return its number, counted from 1."""
        if len(record) > self.capacity:
            raise CodecError("record", len(record), f"is longer than the block's {self.capacity} bytes")
        number = self._words[_NEWEST_AT] + 1
        slot = self._slot(number)
        start = _WORD * (slot + _SLOT_WORDS)
        self._words[slot + _NUMBER] = 0
        self._bytes[start : start + len(record)] = record
        self._words[slot + _CHECK] = len(record) << 32 | zlib.crc32(record, number & 0xFFFFFFFF)
        self._words[slot + _NUMBER] = number
        self._words[_NEWEST_AT] = number
        return number


class BlockReader(_Mapped):
    """A reader of a block, mapped read-only.

    Raises:
        BlockMismatch: the memory behind ``fd`` is not a block of this ``layout``.
    """

    def __init__(self, fd: int, layout: int) -> None:
        super().__init__(fd, layout, writable=False)

    @property
    def newest(self) -> int:
        """Return the number of the newest record; 0 before the first."""
        return self._words[_NEWEST_AT]

    def read(self) -> tuple[int, bytes] | None:
        """Return number and copy of the newest record; None before the first. Never waits for the writer.

        Raises:
            CorruptMessage: the writer overtook every attempt, or another process wrote into the block.
        """
        for _ in range(_ATTEMPTS):
            number = self._words[_NEWEST_AT]
            if number == 0:
                return None
            slot = self._slot(number)
            check = self._words[slot + _CHECK]
            length = check >> 32
            if self._words[slot + _NUMBER] != number or length > self.capacity:
                continue
            start = _WORD * (slot + _SLOT_WORDS)
            record = bytes(self._bytes[start : start + length])
            if self._words[slot + _NUMBER] == number and zlib.crc32(record, number & 0xFFFFFFFF) == check & 0xFFFFFFFF:
                return number, record
        raise CorruptMessage("shared memory", f"no complete record in {_ATTEMPTS} attempts")
