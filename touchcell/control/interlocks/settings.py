"""Base classes of the interlocks' settings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Literal, Self

from pydantic import BaseModel, ConfigDict, model_validator

from touchcell.control.interlocks.violation import Severity
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.control.interlocks.interlock import Interlock
    from touchcell.control.interlocks.timers import TimedInterlock


class InterlockSettings(BaseModel):
    """Base of the settings: unknown keys are refused, no limit has a default.

    Attributes:
        kind: which interlock.
        severity: ``limit`` slows the motion first, ``trip`` stops it, ``fault`` stops it and distrusts the device.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    kind: str
    severity: Literal["trip", "fault"] = "trip"

    @model_validator(mode="after")
    def _leaves_below_its_limit(self) -> Self:
        for name in type(self).model_fields:
            leave, limit = getattr(self, name), getattr(self, name.replace("leave_", "limit_", 1), None)
            if name.startswith("leave_") and leave is not None and limit is not None and leave > limit:
                raise ValueError(f"{name} {leave:g} is above {name.replace('leave_', 'limit_', 1)} {limit:g}")
        return self

    @property
    def measures(self) -> frozenset[str]:
        """Optional measurements of arms that the interlock needs: names of attributes of ``ArmView``."""
        return frozenset()

    @property
    def reads(self) -> frozenset[tuple[str, str]]:
        """What it needs that devices report about themselves: names of devices and of their readings."""
        return frozenset()

    @property
    def level(self) -> Severity:
        """The severity as the interlocks use it."""
        return Severity[self.severity.upper()]

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock | TimedInterlock:
        """Return the interlock.

        Args:
            name: of the entry in the cell file.
            T_tcp_sensor: (4, 4) pose of each sensor in the tool frame, by role.

        Raises:
            ConfigError: the entry names a sensor that the cell does not have.
        """
        raise NotImplementedError(f"{type(self).__name__} builds no interlock")


class GradedSettings(InterlockSettings):
    """Settings of an interlock that may first slow the motion; a limit violation that lasts becomes a trip."""

    severity: Literal["limit", "trip", "fault"] = "trip"  # type: ignore[assignment]


LEAVE = 0.8
"""Hysteresis: default fraction of the limit to which a value must fall before it counts as below again."""
