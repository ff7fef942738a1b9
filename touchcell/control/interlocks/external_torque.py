"""The interlock on the external torques of an arm's joints: contact anywhere on the arm."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, NonNegativeFloat, PositiveFloat

from touchcell.control.interlocks.coverage import (
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    just_beyond,
    role_problem,
    with_arm,
)
from touchcell.control.interlocks.force import LARGEST_NM, fresh_torque
from touchcell.control.interlocks.settings import LEAVE, GradedSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import Reading, Sustained, TimedInterlock
from touchcell.drivers.core.samples import Stamped
from touchcell.geometry.types import Array


@dataclass(frozen=True, slots=True, eq=False)
class _LargestShare:
    """Largest external torque of any joint, in per cent of its limit. Raises ValueError without fresh torques."""

    arm: str
    limits_nm: Array

    def __call__(self, view: CellView) -> Iterator[Reading]:
        torques = fresh_torque(view.arms[self.arm], self.arm, view.now_ns)
        yield Reading(self.arm, 100.0 * float(np.max(np.abs(torques) / self.limits_nm)))


class ExternalTorqueConfig(GradedSettings):
    """Largest external torque of each joint of an arm, and how long it may be exceeded.

    Missing torques are a fault.

    Attributes:
        arm: role of the arm.
        limit_nm: largest torque of each joint, or one number for all.
        hold_ms: time for which it may be exceeded.
    """

    kind: Literal["external_torque"]
    arm: str
    limit_nm: PositiveFloat | Annotated[tuple[PositiveFloat, ...], Field(min_length=1)]
    hold_ms: NonNegativeFloat = 0.0

    @property
    def limits_nm(self) -> Array:
        """(n,) or (1,) limits."""
        return np.atleast_1d(np.asarray(self.limit_nm, dtype=np.float64))

    @property
    def measures(self) -> frozenset[str]:
        """The measurement that it needs of its arm."""
        return frozenset({"external_torque"})

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return a torque that is too large at each joint, and torques that are missing."""
        if (problem := role_problem(self.arm, facts.arms, "arm", "arm")) is not None:
            yield problem
            return
        joints = facts.arms[self.arm].torque_joints
        if joints == 0:
            yield CannotTrip(self.arm, "it reports no external torque", "arm")
            return
        if len(self.limits_nm) not in (1, joints):
            reason = f"it has {joints} joints, and {len(self.limits_nm)} limits are named"
            yield CannotTrip(self.arm, reason, "limit_nm", "name one for each joint, or one for all")
            return

        def loaded(torques: Array) -> Change:
            return lambda view, t_s: with_arm(view, self.arm, external_torque=Stamped(torques, view.now_ns, 0))

        free = loaded(np.zeros(joints))
        for joint, limit in enumerate(np.broadcast_to(self.limits_nm, joints).tolist()):
            torques = np.zeros(joints)
            torques[joint] = -just_beyond(limit, LARGEST_NM)
            what = f"{-torques[joint]:.3g} N m at joint {joint + 1}"
            hint = f"lower it below {LARGEST_NM:g}"
            yield Fault(self.arm, what, f"{limit:g} N m", loaded(torques), free, key="limit_nm", hint=hint)
        silent: Change = lambda view, t_s: with_arm(view, self.arm, external_torque=None)  # noqa: E731
        yield Fault(self.arm, "reports no external torque", "-", silent, free, by_error=True)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on external torques."""
        measure = _LargestShare(self.arm, self.limits_nm)
        what, hold_s = "largest external torque, of its limit:", 1e-3 * self.hold_ms
        return Sustained(name, self.level, measure, what, 100.0, 100.0 * LEAVE, "%", hold_s)


EXTERNAL_TORQUE = InterlockSpec(
    "external_torque", "external torques of an arm's joints stay below limits", ExternalTorqueConfig
)
