"""Shared by the interlocks on contact forces: fresh measurements of the guarded arm, and faults to prove them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final

import numpy as np

from touchcell.control.interlocks.coverage import (
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    role_problem,
    with_arm,
)
from touchcell.control.interlocks.snapshot import ArmView, CellView
from touchcell.drivers.core.samples import Stamped
from touchcell.geometry.types import Array

FRESH_NS: Final = 200_000_000
"""Largest age of a measured force."""
LARGEST_N: Final = 1000.0
"""No arm that works beside people presses harder; limits above never trip."""
LARGEST_NM: Final = 300.0
"""The same for its torques."""


def fresh_wrench(arm: ArmView, role: str, now_ns: int) -> Array:
    """Return the wrench (6,) on an arm's tool. Raises ValueError if it is missing or not fresh."""
    return _fresh(arm.wrench, f"{role} reports no fresh wrench", now_ns)


def fresh_torque(arm: ArmView, role: str, now_ns: int) -> Array:
    """Return the external torques (n,) of an arm's joints. Raises ValueError if they are missing or not fresh."""
    return _fresh(arm.external_torque, f"{role} reports no fresh external torque", now_ns)


def _fresh(sample: Stamped[Array] | None, otherwise: str, now_ns: int) -> Array:
    if sample is None or not 0 <= now_ns - sample.t_ns <= FRESH_NS:
        raise ValueError(otherwise)
    return sample.value


def wrench_faults(
    arm: str, facts: CellFacts, faults: Callable[[Callable[[Array], Change], Change], Iterator[Fault]]
) -> Iterator[Fault | CannotTrip]:
    """Return the faults of an interlock on an arm's wrench, and its silence, or why it cannot trip.

    Args:
        arm: role of the arm.
        facts: of the cell.
        faults: makes the faults, given what puts a wrench (6,) into a snapshot, and the change to none.
    """
    if (problem := role_problem(arm, facts.arms, "arm", "arm")) is not None:
        yield problem
        return
    if not facts.arms[arm].wrench:
        yield CannotTrip(arm, "it reports no wrench", "arm", "only arms with a wrench can be guarded in this way")
        return

    def pushed(wrench: Array) -> Change:
        return lambda view, t_s: with_arm(view, arm, wrench=Stamped(wrench, view.now_ns, 0))

    yield from faults(pushed, pushed(np.zeros(6)))

    def silent(view: CellView, t_s: float) -> CellView:
        return with_arm(view, arm, wrench=None)

    yield Fault(arm, "reports no wrench", "-", silent, pushed(np.zeros(6)), by_error=True)
