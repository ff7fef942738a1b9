"""A cell file on the simulator's own contacts, to see control apart from estimation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

_OF_NETWORKS: Final = frozenset({"uncertain", "out_of_range", "inconsistent", "markers_lost"})
_OF_IMAGES: Final = frozenset({"exposure"})


def put_on_true_contact(data: dict[str, Any]) -> None:
    """Replace every network of a cell file by the true contact, and leave out what then cannot trip.

    Args:
        data: the cell file, which is changed.
    """
    for sensor in data["sensors"].values():
        if sensor["estimator"]["kind"] == "network":
            sensor["estimator"] = {"kind": "true_contact"}
    data["interlocks"] = answerable(data)


def answerable(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the interlocks of a cell file without those that ask what none of its estimators reports.

    Standard deviations, training ranges, innovations and markers are reported by networks only, and the true contact
    comes without images. A cell with such an interlock would be refused.
    """
    kinds = {sensor["estimator"]["kind"] for sensor in data.get("sensors", {}).values()}
    unanswered = set() if "network" in kinds else set(_OF_NETWORKS)
    if not kinds & {"network", "known_surface"}:
        unanswered |= _OF_IMAGES
    return {name: entry for name, entry in data.get("interlocks", {}).items() if entry["kind"] not in unanswered}
