"""How far an arm or a sensor is on its way to the limit of an interlock, for people who watch a run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Level:
    """A quantity beside its limit.

    Attributes:
        subject: role of the arm or sensor.
        value: 0 at rest; above ``limit`` it violates the interlock, where that says for how long it may be.
        limit: in ``unit``, as ``value``.
        unit: of both.
    """

    subject: str
    value: float
    limit: float
    unit: str
