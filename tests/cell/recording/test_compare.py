"""Two recordings are the same to the last bit, or the first difference is named."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.cell.recording.compare import compare_recordings
from touchcell.cell.recording.recorder import Recorder

Messages = Sequence[tuple[str, int, dict[str, Any]]]
BASE: Messages = [("/a", 1, {"x": 0.1, "y": [1, 2.5]}), ("/a", 2, {"x": 0.2, "y": [3.5]}), ("/b", 2, {"name": "n"})]


def recorded(path: Path, messages: Messages) -> Path:
    with Recorder(path) as recorder:
        for topic, t_ns, data in messages:
            recorder.write(topic, t_ns, data)
    return path


def differences(tmp_path: Path, first: Messages, second: Messages, **how: Any) -> dict[str, str]:
    rows = compare_recordings(recorded(tmp_path / "1.mcap", first), recorded(tmp_path / "2.mcap", second), **how)
    return {row.topic: row.difference for row in rows if not row.identical}


def test_the_same_is_identical_and_durations_do_not_count(tmp_path: Path) -> None:
    other = [*BASE, ("/timing", 3, {"cycle_us": 2})]
    assert differences(tmp_path, [*BASE, ("/timing", 3, {"cycle_us": 1})], other) == {}


@pytest.mark.parametrize(
    ("change", "topic", "difference"),
    [
        (("/a", 2, {"x": 0.2 + 2**-55, "y": [3.5]}), "/a", "x is 0.2, then 0.20000000000000004"),
        (("/a", 3, {"x": 0.2, "y": [3.5]}), "/a", "at 2 ns, then at 3 ns"),
        (("/a", 2, {"y": [3.5]}), "/a", "x is only in the first"),
        (("/a", 2, {"x": 0.2, "y": [3.5], "z": 1}), "/a", "z is only in the second"),
        (("/a", 2, {"x": 0.2, "y": []}), "/a", "y is [3.5], then []"),
        (("/a", 2, {"x": "0.2", "y": [3.5]}), "/a", "x is 0.2, then '0.2'"),
    ],
)
def test_the_first_difference_is_named(
    tmp_path: Path, change: tuple[str, int, dict[str, Any]], topic: str, difference: str
) -> None:
    found = differences(tmp_path, BASE, [BASE[0], change, BASE[2]])
    assert found.keys() == {topic}
    assert difference in found[topic]
    assert "message 1" in found[topic]


def test_signs_of_zero_and_kinds_of_number_differ(tmp_path: Path) -> None:
    assert differences(tmp_path, [("/a", 1, {"x": 0.0})], [("/a", 1, {"x": -0.0})])
    assert differences(tmp_path, [("/a", 1, {"x": 1.0})], [("/a", 1, {"x": 1})])


def test_a_topic_or_a_message_that_is_missing_differs(tmp_path: Path) -> None:
    assert differences(tmp_path, BASE, BASE[:2]) == {"/b": "1 messages, then 0"}
    assert differences(tmp_path, BASE[1:], BASE[1:2] * 2 + list(BASE[2:])) == {"/a": "1 messages, then 2"}


def test_renamed_keys_are_compared_under_their_new_name(tmp_path: Path) -> None:
    first, second = [("/task", 1, {"rest_mm": 3.0})], [("/task", 1, {"remaining_mm": 3.0})]
    assert differences(tmp_path, first, second) != {}
    assert differences(tmp_path, first, second, renamed={"rest_mm": "remaining_mm"}) == {}


@settings(max_examples=25)
@given(value=st.floats(allow_nan=False, allow_infinity=False))
def test_a_float_survives_the_file_to_the_last_bit(tmp_path_factory: pytest.TempPathFactory, value: float) -> None:
    message: Messages = [("/a", 1, {"x": value})]
    assert differences(tmp_path_factory.mktemp("compare"), message, message) == {}
