"""Where a donated capture differs from what a codec or an emulator assumes, named by frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Difference:
    """One difference.

    Attributes:
        t_s: time of the frame, s, by the clock of the capture.
        frame: number of the frame in the capture, from 1.
        field: what differs, such as ``servo 2 position``.
        expected: what codec or emulator assume.
        seen: what the device sent.
    """

    t_s: float
    frame: int
    field: str
    expected: str
    seen: str

    def __str__(self) -> str:
        return f"frame {self.frame} at {self.t_s:.6f} s: {self.field}: expected {self.expected}, seen {self.seen}"


def report(differences: Iterable[Difference]) -> Iterator[str]:
    """Yield a line for the first difference of each field and expectation, with the number of others like it."""
    first: dict[tuple[str, str], Difference] = {}
    counts: dict[tuple[str, str], int] = {}
    for difference in differences:
        key = (difference.field, difference.expected)
        first.setdefault(key, difference)
        counts[key] = counts.get(key, 0) + 1
    for key, difference in first.items():
        more = counts[key] - 1
        yield f"{difference}{f', and {more} more like it' if more else ''}"
