"""Commands of ur-rtde's control program that move nothing: questions, settings, and what they answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.host import ProgramError, ProgramHost
from touchcell.drivers.ur.emulator.program_registers import ProgramRegisters
from touchcell.geometry.types import Array

_NEARLY_SINGULAR, _SINGULAR = 0.05, 0.01
_JOINT_END_RAD = 2.0 * np.pi


class Queries:
    """Answers to the commands in ``self.commands``, each given in one period.

    Args:
        host: controller that runs the program.
        registers: through which a client asks, and is answered.

    Attributes:
        commands: what to do, by the number of the command.
        waypoint: (6,) pose to which the last move goes, with rotation vector.
    """

    def __init__(self, host: ProgramHost, registers: ProgramRegisters) -> None:
        self._host = host
        self._registers = registers
        self.waypoint = ur_model.pose_vector(host.arm.T_base_tcp)
        self.commands: Mapping[int, Callable[[], None]] = {
            8: host.zero_wrench,
            17: self._set_payload,
            20: lambda: self._accept("damping", 0.0, 1.0),
            21: lambda: self._accept("gain scaling", 0.0, 2.0),
            25: lambda: registers.decide(host.contact_steps(registers.vector(0)[:3])),
            26: lambda: registers.reply(np.array([host.period_s])),
            27: lambda: registers.reply(host.joints_before(registers.integer(1))),
            28: lambda: registers.reply(self.waypoint),
            29: lambda: host.set_tool(ur_model.from_pose_vector(registers.vector(0))),
            30: lambda: registers.reply(self.inverse(registers.vector(0), registers.vector(6))),
            35: lambda: host.set_watchdog(registers.double(0)),
            36: lambda: registers.decide(self._is_reachable(registers.vector(0))),
            37: lambda: registers.decide(self._is_in_range(registers.vector(0))),
            38: lambda: registers.reply(host.arm.J.T @ host.felt_wrench()),
            39: self._pose_trans,
            40: lambda: registers.reply(ur_model.pose_vector(host.arm.T_flange_tcp)),
            43: lambda: registers.reply(ur_model.pose_vector(host.arm.T_base_tcp)),
            44: self._forward,
            46: lambda: registers.reply(self.inverse(registers.vector(0))),
            47: lambda: registers.decide(not host.arm.qd.any() and host.compliance is None),
            54: lambda: registers.decide(self._freedrive_status()),
            56: lambda: host.use_external_wrench(self._flag()),
            57: lambda: host.use_external_wrench(self._flag()),
            58: self._flange_pose,
            59: lambda: self._finite("gravity", registers.vector(0)[:3]),
            60: lambda: registers.decide(self._solution(registers.vector(0), None) is not None),
            61: lambda: registers.decide(self._solution(registers.vector(0), registers.vector(6)) is not None),
            65: self._set_payload,
        }

    def inverse(self, pose: Array, q_near: Array | None = None) -> Array:
        """Return joint angles (6,) that reach ``pose`` (6,). Raises ProgramError as ``get_inverse_kin`` does."""
        q = self._solution(pose, q_near)
        if q is None:
            raise ProgramError("get_inverse_kin: no solution")
        return q

    def forward(self, q: Array) -> Array:
        """Return the pose (4, 4) of the tool at ``q`` (6,)."""
        arm = self._host.arm
        return ur_model.forward(q, arm.T_flange_tcp, arm.model)[0]

    def _solution(self, pose: Array, q_near: Array | None) -> Array | None:
        arm = self._host.arm
        near = arm.q if q_near is None else q_near
        return ur_model.inverse(ur_model.from_pose_vector(pose), near, arm.T_flange_tcp, arm.model)

    def _is_in_range(self, q: Array) -> bool:
        return bool((np.abs(q) <= _JOINT_END_RAD).all())

    def _is_reachable(self, pose: Array) -> bool:
        q = self._solution(pose, None)
        return q is not None and self._is_in_range(q)

    def _pose_trans(self) -> None:
        first, second = (ur_model.from_pose_vector(self._registers.vector(at)) for at in (0, 6))
        self._registers.reply(ur_model.pose_vector(first @ second))

    def _forward(self) -> None:
        tool = ur_model.from_pose_vector(self._registers.vector(6))
        T, _ = ur_model.forward(self._registers.vector(0), tool, self._host.arm.model)
        self._registers.reply(ur_model.pose_vector(T))

    def _flange_pose(self) -> None:
        arm = self._host.arm
        self._registers.reply(ur_model.pose_vector(arm.T_base_tcp @ np.linalg.inv(arm.T_flange_tcp)))

    def _freedrive_status(self) -> int:
        smallest = float(np.linalg.svd(self._host.arm.J, compute_uv=False)[-1])
        return 2 if smallest < _SINGULAR else 1 if smallest < _NEARLY_SINGULAR else 0

    def _set_payload(self) -> None:
        mass_kg = self._registers.double(0)
        centre = np.array([self._registers.double(i) for i in (1, 2, 3)])
        if not (mass_kg >= 0.0 and np.isfinite(centre).all()):
            raise ProgramError(f"a payload of {mass_kg} kg at {centre} m is impossible")
        # A centre of all zeros stands for the one that was set before.
        self._host.set_payload(mass_kg, centre if centre.any() else None)

    def _flag(self) -> bool:
        value = self._registers.integer(1)
        if value not in (0, 1):
            raise ProgramError(f"{value} is neither on nor off")
        return value == 1

    def _accept(self, name: str, lowest: float, highest: float) -> None:
        value = self._registers.double(0)
        if not lowest <= value <= highest:
            raise ProgramError(f"{name} {value} of the force mode is not within [{lowest:g}, {highest:g}]")

    @staticmethod
    def _finite(name: str, values: Array) -> None:
        if not np.isfinite(values).all():
            raise ProgramError(f"{name} is not finite")
