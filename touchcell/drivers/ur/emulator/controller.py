"""Model of a UR controller: power, safety, program, registers and arm, stepped once in its control period."""

from __future__ import annotations

import math
import re
from collections import Counter, deque

import numpy as np

from touchcell.drivers.ur.codec import Value
from touchcell.drivers.ur.emulator import kinematics as ur_model
from touchcell.drivers.ur.emulator.compliance import Compliance
from touchcell.drivers.ur.emulator.host import ProgramError
from touchcell.drivers.ur.emulator.motion import ArmState, Brake, Motion
from touchcell.drivers.ur.emulator.program import NAMES, ControlProgram, injected_path
from touchcell.drivers.ur.emulator.script import ScriptError, Statement, parse_lines, parse_program
from touchcell.drivers.ur.emulator.statements import ScriptProgram
from touchcell.drivers.ur.modes import RobotMode, RuntimeState, SafetyBits, SafetyMode
from touchcell.geometry.types import Array
from touchcell.testing.emulation.base import CommandOnset

HOME_Q = np.radians([0.0, -90.0, -90.0, -90.0, 90.0, 0.0])
_STOP_PROGRAM_DECEL_RAD_S2 = 4.0
_SAFETY_DECEL_RAD_S2 = 12.0
_JOINT_SPEED_LIMIT_RAD_S = math.radians(191.0)
_START_S = 0.02
_POWER_S = 0.05
_HISTORY = 500
# Of this emulator: the force from which the tool has contact is not published.
_CONTACT_N = 5.0

_BITS = {
    SafetyMode.NORMAL: SafetyBits.NORMAL_MODE,
    SafetyMode.REDUCED: SafetyBits.REDUCED_MODE,
    SafetyMode.PROTECTIVE_STOP: SafetyBits.PROTECTIVE_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.RECOVERY: SafetyBits.RECOVERY_MODE,
    SafetyMode.SAFEGUARD_STOP: SafetyBits.SAFEGUARD_STOPPED | SafetyBits.STOPPED_DUE_TO_SAFETY,
    SafetyMode.SYSTEM_EMERGENCY_STOP: SafetyBits.SYSTEM_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED,
    SafetyMode.ROBOT_EMERGENCY_STOP: SafetyBits.ROBOT_EMERGENCY_STOPPED | SafetyBits.EMERGENCY_STOPPED,
    SafetyMode.VIOLATION: SafetyBits.VIOLATION,
    SafetyMode.FAULT: SafetyBits.FAULT,
}
_PAUSING = (SafetyMode.PROTECTIVE_STOP, SafetyMode.SAFEGUARD_STOP, SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP)


class Controller:
    """State of the controller; ``step`` advances it by one control period.

    Args:
        unlock_after_s: time after a protective stop before it can be unlocked (5 s on the real controller).
        q: (6,) rad joint angles at which it begins.
        model: lengths of the arm.
        period_s: control period.
    """

    def __init__(
        self,
        unlock_after_s: float = 5.0,
        q: Array = HOME_Q,
        model: ur_model.Model = ur_model.UR5E,
        period_s: float = 0.002,
    ) -> None:
        self._unlock_after_s = unlock_after_s
        self.period_s = period_s
        self.energising = 0
        self.commands: Counter[str] = Counter()
        self.onset = CommandOnset()
        self.messages: deque[str] = deque(maxlen=20)
        self.watchdog_trips = 0
        self.remote_control = True
        self.speed_slider = 1.0
        self.wrench = np.zeros(6)
        self._zero_wrench = np.zeros(6)
        self._takes_external_wrench = False
        self.payload_kg = 0.0
        self.payload_centre_m = np.zeros(3)
        self.temperature_c = 31.0
        self.voltage_v = 48.0
        self.digital_outputs = 0
        self.arm = ArmState(q, model)
        self.inputs: dict[str, Value] = {}
        self._boot(RobotMode.RUNNING)

    def _boot(self, robot_mode: RobotMode) -> None:
        self.t_s = 0.0
        self.robot_mode = robot_mode
        self.safety_mode = SafetyMode.NORMAL
        self.runtime_state = RuntimeState.STOPPED
        self.outputs: dict[str, Value] = {}
        self.motion: Motion | None = None
        self.compliance: Compliance | None = None
        self._history = deque([self.arm.q], _HISTORY)
        self._contact_periods = 0
        self.watchdog_hz = 0.0
        self._program: ControlProgram | ScriptProgram | None = None
        self._foreign_program = False
        self._starting: tuple[float, ControlProgram | ScriptProgram] | None = None
        self._powering: tuple[float, RobotMode] | None = None
        self._input_s = 0.0
        self._input_travel_m = 0.0
        self._stopped_s = -math.inf

    @property
    def energised(self) -> bool:
        """True if the brakes are released."""
        return self.robot_mode is RobotMode.RUNNING

    @property
    def last_input_age_s(self) -> float:
        """Return the seconds since input_int_register_0 (or 24) was last written."""
        return self.t_s - self._input_s

    @property
    def travel_since_input_m(self) -> float:
        """Return the distance the tool has moved since then."""
        return self.arm.travel_m - self._input_travel_m

    def step(self) -> None:
        """Advance by one control period."""
        self.t_s += self.period_s
        if self._powering is not None and self.t_s >= self._powering[0]:
            self.robot_mode = self._powering[1]
            self._powering = None
        if self._starting is not None and self.t_s >= self._starting[0]:
            self._program = self._starting[1]
            self._starting = None
            self.runtime_state = RuntimeState.PLAYING
        self._watch()
        self._run_program()
        self._note()
        if (self.motion is not None or self.compliance is not None) and self.energised:
            q = self.arm.q
            if self.motion is not None:
                q = self.motion.advance(self.arm, self.period_s, self.speed_slider)
            if self.compliance is not None:
                giving = self.compliance.twist(self.felt_wrench())
                q = q + ur_model.joint_speeds(self.arm.J, giving) * self.period_s
            self.arm.move_to(q, self.period_s)
            if float(np.abs(self.arm.qd).max()) > _JOINT_SPEED_LIMIT_RAD_S:
                self.protective_stop()
            elif self.motion is not None and self.motion.done:
                self.motion = None
        elif self.arm.qd.any():
            self.arm.move_to(self.arm.q, self.period_s)

    def _note(self) -> None:
        """Remember where the arm was, and for how long its tool has had contact."""
        self._history.appendleft(self.arm.q)
        in_contact = float(np.linalg.norm(self.felt_wrench()[:3])) > _CONTACT_N
        self._contact_periods = min(self._contact_periods + 1, _HISTORY - 1) if in_contact else 0

    def _watch(self) -> None:
        late = self.watchdog_hz > 0.0 and self.last_input_age_s > 1.0 / self.watchdog_hz
        if late and self.runtime_state is RuntimeState.PLAYING:
            self.watchdog_trips += 1
            self.log(f"no input for {self.last_input_age_s:.3f} s: program stopped by its watchdog")
            self.stop_program()

    def _run_program(self) -> None:
        if self._program is None or self.runtime_state is not RuntimeState.PLAYING:
            return
        try:
            if not self._program.step():
                self.stop_program()
        except ProgramError as error:
            self.log(f"program stopped: {error}")
            self.stop_program()

    def write_inputs(self, values: dict[str, Value]) -> None:
        """Apply a data packet. Registers keep their values when a program stops or a client disconnects."""
        self.inputs.update(values)
        self._set_slider(values)
        self._set_digital_outputs(values)
        speeds = tuple(value for name, value in values.items() if "double" in name)
        if speeds:
            self.onset.note("arm", speeds)
        for register in ("input_int_register_0", "input_int_register_24"):
            command = values.get(register)
            if isinstance(command, int):
                self._input_s = self.t_s
                self._input_travel_m = self.arm.travel_m
                self.commands[NAMES.get(command, str(command))] += 1

    def _set_slider(self, values: dict[str, Value]) -> None:
        fraction = values.get("speed_slider_fraction")
        if values.get("speed_slider_mask") == 1 and isinstance(fraction, float) and 0.0 <= fraction <= 1.0:
            self.speed_slider = fraction

    def _set_digital_outputs(self, values: dict[str, Value]) -> None:
        for group, first in (("standard", 0), ("configurable", 8), ("tool", 16)):
            mask, levels = values.get(f"{group}_digital_output_mask"), values.get(f"{group}_digital_output")
            if isinstance(mask, int) and isinstance(levels, int):
                self.set_outputs(mask << first, levels << first)

    def set_outputs(self, mask: int, levels: int) -> None:
        """Switch the digital outputs in ``mask`` (bits of ``actual_digital_output_bits``)."""
        self.digital_outputs = self.digital_outputs & ~mask | levels & mask

    def start_program(self, text: str) -> None:
        """Run an uploaded script if the arm is powered, safe, and in remote control, and the script is understood.

        Understood are the control program of ur-rtde and straight-line programs.
        """
        if not (self.remote_control and self.energised and self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)):
            self.log("script rejected: not in remote control, not powered or not safe")
            return
        try:
            program = self._control_program(text) if self._is_ours(text) else ScriptProgram(self, parse_program(text))
        except ScriptError as error:
            self.log(f"script rejected: {error}")
            return
        self.energising += 1
        self.commands["script"] += 1
        self.stop_program()
        self._starting = (self.t_s + _START_S, program)

    @staticmethod
    def _is_ours(text: str) -> bool:
        return bool(re.match(r"\s*def rtde_control\(\):", text)) and "rtde_set_watchdog" in text and "$" not in text

    def _control_program(self, text: str) -> ControlProgram:
        offset = re.search(r"reg_offset_int = *#[^\n]*\n\s*(\d+)", text)
        path: tuple[Statement, ...] = tuple(parse_lines(list(injected_path(text))))
        return ControlProgram(self, int(offset[1]) if offset else 0, path)

    def play_foreign_program(self) -> None:
        """Start a program that is not ours."""
        self._foreign_program = True
        self.runtime_state = RuntimeState.PLAYING

    def stop_program(self) -> None:
        """End the running program; the arm decelerates and holds."""
        self._program = None
        self._starting = None
        self._foreign_program = False
        self.compliance = None
        self.watchdog_hz = 0.0
        self.runtime_state = RuntimeState.STOPPED
        if self.motion is not None:
            self.motion = Brake(_STOP_PROGRAM_DECEL_RAD_S2, linear=False)

    def play(self) -> bool:
        """Resume a paused program; as on a real controller, it continues its interrupted motion."""
        if self.runtime_state is not RuntimeState.PAUSED or self.safety_mode is not SafetyMode.NORMAL:
            return False
        self.energising += 1
        self.runtime_state = RuntimeState.PLAYING
        return True

    def pause(self) -> bool:
        """Pause a playing program, as the pendant does: the arm decelerates, and the program waits for play."""
        if self.runtime_state is not RuntimeState.PLAYING:
            return False
        self.runtime_state = RuntimeState.PAUSED
        if self.motion is not None:
            self.motion = Brake(_STOP_PROGRAM_DECEL_RAD_S2, linear=False)
        return True

    def protective_stop(self) -> None:
        """Brake hard and pause the program."""
        self.stop_by_safety(SafetyMode.PROTECTIVE_STOP)

    def stop_by_safety(self, mode: SafetyMode) -> None:
        """Enter a safety mode: pausing ones pause the program, the others end it and cut the power."""
        self.safety_mode = mode
        self._stopped_s = self.t_s
        if mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            if self._powering is not None and self._powering[1] is RobotMode.POWER_OFF:
                # A button that is released before the power is cut does not keep it.
                self.robot_mode, self._powering = RobotMode.POWER_OFF, None
            return
        self.compliance = None
        if self.motion is not None:
            self.motion = Brake(_SAFETY_DECEL_RAD_S2, linear=False)
        if mode in _PAUSING:
            if self.runtime_state is RuntimeState.PLAYING:
                self.runtime_state = RuntimeState.PAUSED
        else:
            self.stop_program()
            self._powering = (self.t_s + 0.5, RobotMode.POWER_OFF)

    def unlock_protective_stop(self) -> bool:
        """Leave a protective stop; False if it is too early."""
        if self.safety_mode is not SafetyMode.PROTECTIVE_STOP:
            return True
        if self.t_s - self._stopped_s < self._unlock_after_s:
            return False
        self.energising += 1
        self.safety_mode = SafetyMode.NORMAL
        return True

    def restart_safety(self) -> None:
        """Leave a safety fault or violation; the arm is powered off."""
        if self.safety_mode in (SafetyMode.FAULT, SafetyMode.VIOLATION):
            self.safety_mode = SafetyMode.NORMAL
            self.power(RobotMode.POWER_OFF)

    def power(self, mode: RobotMode) -> None:
        """Power on (IDLE), release the brakes (RUNNING) or power off."""
        if mode is RobotMode.POWER_OFF:
            self.stop_program()
            self.motion = None
            self.robot_mode = mode
        elif self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            self.energising += 1
            self._powering = (self.t_s + _POWER_S, mode)

    def restart(self) -> None:
        """Restart the controller: its clock from 0, no program, the arm powered off at its present position."""
        self.arm.move_to(self.arm.q, self.period_s)
        self._boot(RobotMode.POWER_OFF)
        self.inputs.clear()

    def give_way(self, compliance: Compliance | None) -> None:
        """Begin or, with None, end a mode in which the tool gives way to forces."""
        self.energising += compliance is not None and self.compliance is None
        self.compliance = compliance

    def set_payload(self, mass_kg: float, centre_m: Array | None) -> None:
        """Set mass and, unless None, centre of mass (3,) of the payload."""
        self.energising += 1
        self.payload_kg = mass_kg
        if centre_m is not None:
            self.payload_centre_m = centre_m

    def felt_wrench(self) -> Array:
        """Return the wrench (6,) on the tool as measured, along base axes."""
        external = self.inputs.get("external_force_torque")
        if self._takes_external_wrench:
            return np.array(external, dtype=np.float64) if isinstance(external, tuple) else np.zeros(6)
        return self.wrench - self._zero_wrench

    def zero_wrench(self) -> None:
        """Count the present wrench as none from now on."""
        self.energising += 1
        self._zero_wrench = self.wrench.copy()

    def use_external_wrench(self, enable: bool) -> None:
        """Take the wrench from the client's ``external_force_torque`` instead of the own sensor."""
        self._takes_external_wrench = enable

    def contact_steps(self, direction: Array) -> int:
        """Return for how many periods the tool has had contact against ``direction`` (3,), in any if that is zero."""
        length = float(np.linalg.norm(direction))
        against = length == 0.0 or float(self.felt_wrench()[:3] @ direction) < -_CONTACT_N * length
        return self._contact_periods if against else 0

    def joints_before(self, steps: int) -> Array:
        """Return the joint angles (6,) of ``steps`` periods ago, of the oldest known at most."""
        return self._history[max(0, min(steps, len(self._history) - 1))]

    def set_tool(self, T_flange_tcp: Array) -> None:
        """Change the tool centre point."""
        self.energising += 1
        self.arm.T_flange_tcp = T_flange_tcp
        self.arm.refresh()

    def set_watchdog(self, min_hz: float) -> None:
        """Stop the program when inputs arrive at less than ``min_hz``; 0 disables the watchdog."""
        self.watchdog_hz = min_hz
        self._input_s = self.t_s

    def log(self, message: str) -> None:
        """Append a message to the log in the emulator's state."""
        self.messages.append(f"{self.t_s:.3f} {message}")

    def values(self) -> dict[str, Value]:
        """Return every variable that RTDE can stream, except registers."""
        arm = self.arm
        pose = _six(ur_model.pose_vector(arm.T_base_tcp))
        twist, q, qd = _six(arm.twist), _six(arm.q), _six(arm.qd)
        playing = self.runtime_state is RuntimeState.PLAYING
        powered = self.robot_mode >= RobotMode.POWER_ON
        return {
            "timestamp": self.t_s,
            "actual_q": q,
            "target_q": q,
            "actual_qd": qd,
            "target_qd": qd,
            "actual_TCP_pose": pose,
            "target_TCP_pose": pose,
            "actual_TCP_speed": twist,
            "target_TCP_speed": twist,
            "actual_TCP_force": _six(self.felt_wrench()),
            "ft_raw_wrench": _six(self.wrench),
            "robot_mode": int(self.robot_mode),
            "safety_mode": int(self.safety_mode),
            "safety_status": int(self.safety_mode),
            "safety_status_bits": int(_BITS.get(self.safety_mode, SafetyBits.STOPPED_DUE_TO_SAFETY)),
            "robot_status_bits": int(powered) | int(playing) << 1,
            "runtime_state": int(self.runtime_state),
            "speed_scaling": self.speed_slider,
            "target_speed_fraction": self.speed_slider,
            "joint_mode": (253,) * 6 if self.energised else (249,) * 6,
            "joint_temperatures": (self.temperature_c,) * 6,
            "actual_main_voltage": self.voltage_v,
            "actual_robot_voltage": self.voltage_v,
            "actual_digital_output_bits": self.digital_outputs,
            "payload": self.payload_kg,
            "payload_cog": _six(self.payload_centre_m),
            "tcp_offset": _six(ur_model.pose_vector(arm.T_flange_tcp)),
        }


def _six(values: Array) -> tuple[float, ...]:
    return tuple(values.tolist())
