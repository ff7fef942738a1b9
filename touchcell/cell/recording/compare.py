"""Compare two recordings topic by topic: the same numbers to the last bit, at the same times, in the same order."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from touchcell.cell.recording.mcap import read

WALL_CLOCK_TOPICS: Final = frozenset({"/timing"})
"""Topics whose numbers are durations on the machine that recorded them."""


@dataclass(frozen=True, slots=True)
class TopicComparison:
    """Comparison of one topic in two recordings."""

    topic: str
    counts: tuple[int, int]
    difference: str

    @property
    def identical(self) -> bool:
        """True if every message is identical."""
        return not self.difference


def compare_recordings(
    first: Path,
    second: Path,
    *,
    ignored: Collection[str] = WALL_CLOCK_TOPICS,
    renamed: Mapping[str, str] | None = None,
) -> list[TopicComparison]:
    """Compare two recordings, sorted by topic.

    A message is the same when its stamp, its keys and its values are: floats bit for bit (so -0.0 differs from 0.0),
    whatever the order of its keys.

    Args:
        first, second: MCAP files.
        ignored: topics that are left out.
        renamed: keys of ``first`` that have another name in ``second``.

    Raises:
        RecordingError: a file is missing or no recording.
    """
    names = renamed or {}
    messages = [_by_topic(path, ignored) for path in (first, second)]
    return [
        _compare(topic, messages[0].get(topic, []), messages[1].get(topic, []), names)
        for topic in sorted(messages[0].keys() | messages[1].keys())
    ]


def _by_topic(path: Path, ignored: Collection[str]) -> dict[str, list[tuple[int, dict[str, Any]]]]:
    found: dict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    for message in read(path):
        if message.topic not in ignored:
            found[message.topic].append((message.t_ns, message.data))
    return found


def _compare(
    topic: str,
    first: list[tuple[int, dict[str, Any]]],
    second: list[tuple[int, dict[str, Any]]],
    renamed: Mapping[str, str],
) -> TopicComparison:
    counts = len(first), len(second)
    for k, ((t_ns, data), (other_ns, other)) in enumerate(zip(first, second, strict=False)):
        if t_ns != other_ns:
            return TopicComparison(topic, counts, f"message {k}: at {t_ns} ns, then at {other_ns} ns")
        mapped = {renamed.get(key, key): value for key, value in data.items()}
        for difference in _differences("", mapped, other):
            return TopicComparison(topic, counts, f"message {k} at {t_ns} ns: {difference}")
    return TopicComparison(topic, counts, "" if counts[0] == counts[1] else f"{counts[0]} messages, then {counts[1]}")


def _differences(where: str, first: Any, second: Any) -> Iterator[str]:
    if isinstance(first, dict) and isinstance(second, dict):
        for key in (*first, *(key for key in second if key not in first)):
            if key not in first or key not in second:
                yield f"{where}{key} is only in the {'first' if key in first else 'second'}"
            else:
                yield from _differences(f"{where}{key}.", first[key], second[key])
    elif isinstance(first, list) and isinstance(second, list) and len(first) == len(second):
        for k, (one, other) in enumerate(zip(first, second, strict=True)):
            yield from _differences(f"{where}{k}.", one, other)
    elif _bits(first) != _bits(second):
        yield f"{where.rstrip('.')} is {first!r}, then {second!r}"


def _bits(value: Any) -> Any:
    """Return the compared representation of a value: a float's bits, and the type of everything."""
    return type(value), value.hex() if isinstance(value, float) else value
