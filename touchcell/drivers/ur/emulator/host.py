"""Interface of the controller to the programs that it runs."""

from __future__ import annotations

from collections.abc import Generator
from typing import Protocol

from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.emulator.compliance import Compliance
from touchcell.drivers.ur.emulator.motion import ArmState, Motion
from touchcell.geometry.types import Array

Thread = Generator[None, None, None]
"""A thread of a program: each ``yield`` is one ``sync()``."""


class ProgramError(Exception):
    """A run-time error of the program: the controller stops it."""


class ProgramHost(Protocol):
    """Interface of the controller that runs a program."""

    arm: ArmState
    motion: Motion | None
    compliance: Compliance | None
    inputs: dict[str, Value]
    outputs: dict[str, Value]
    period_s: float

    def give_way(self, compliance: Compliance | None) -> None:
        """Begin or, with None, end a mode in which the tool gives way to forces."""
        ...

    def set_tool(self, T_flange_tcp: Array) -> None:
        """Set the tool centre point."""
        ...

    def set_payload(self, mass_kg: float, centre_m: Array | None) -> None:
        """Set mass and, unless None, centre of mass (3,) of the payload."""
        ...

    def set_watchdog(self, min_hz: float) -> None:
        """Require a minimum rate of input packets."""
        ...

    def set_outputs(self, mask: int, levels: int) -> None:
        """Switch the digital outputs in ``mask`` (bits of ``actual_digital_output_bits``)."""
        ...

    def felt_wrench(self) -> Array:
        """Return the wrench (6,) on the tool as measured, along base axes."""
        ...

    def zero_wrench(self) -> None:
        """Count the present wrench as none from now on."""
        ...

    def use_external_wrench(self, enable: bool) -> None:
        """Take the wrench from the client's ``external_force_torque`` instead of the own sensor."""
        ...

    def contact_steps(self, direction: Array) -> int:
        """Return for how many periods the tool has had contact against ``direction`` (3,), in any if that is zero."""
        ...

    def joints_before(self, steps: int) -> Array:
        """Return the joint angles (6,) of ``steps`` periods ago."""
        ...

    def protective_stop(self) -> None:
        """Stop the arm and latch the protective stop."""
        ...

    def log(self, message: str) -> None:
        """Write to the controller's log."""
        ...
