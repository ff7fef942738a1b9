"""A cell file on the simulator's own contacts, to see control apart from estimation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

_OF_NETWORKS: Final = frozenset({"uncertain", "out_of_range", "inconsistent", "markers_lost"})
_TRUTH_OF: Final = {"network": "true_contact", "edge_network": "true_edge"}
"""Estimator by a network -> the truth that it estimates."""
_OF_IMAGES: Final = frozenset({"exposure"})


def put_on_true_contact(data: dict[str, Any]) -> None:
    """Replace every network of a cell file by the true contact, and leave out what then cannot trip.

    Args:
        data: the cell file, which is changed.
    """
    for sensor in data["sensors"].values():
        replaced = _TRUTH_OF.get(sensor["estimator"]["kind"])
        if replaced is not None:
            sensor["estimator"] = {"kind": replaced}
    data["interlocks"] = answerable(data)


def answerable(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the interlocks of a cell file without those that ask what none of its estimators reports.

    Standard deviations, training ranges, innovations and markers are reported by networks only, and the true contact
    comes without images. A cell with such an interlock would be refused.
    """
    sensors, interlocks = data.get("sensors"), data.get("interlocks")
    if not isinstance(sensors, Mapping) or not isinstance(interlocks, Mapping):
        return dict(interlocks) if isinstance(interlocks, Mapping) else {}
    kinds = {_kind(sensor.get("estimator")) for sensor in sensors.values() if isinstance(sensor, Mapping)}
    unanswered = set() if kinds & set(_TRUTH_OF) else set(_OF_NETWORKS)
    if not kinds & {*_TRUTH_OF, "known_surface", "true_edge"}:
        unanswered |= _OF_IMAGES
    return {name: entry for name, entry in interlocks.items() if _kind(entry) not in unanswered}


def _kind(section: Any) -> str:
    """Return the ``kind`` of a section, empty where a file that is not checked yet names none."""
    kind = section.get("kind") if isinstance(section, Mapping) else None
    return kind if isinstance(kind, str) else ""
