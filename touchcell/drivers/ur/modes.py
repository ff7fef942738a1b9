"""Modes of a Universal Robots controller, and the faults among them.

Numbers and names: Universal Robots, "Real-Time Data Exchange (RTDE) Guide" (robot_mode, safety_mode, runtime_state,
safety_status_bits) and "Remote Control via TCP/IP" (client interface of PolyScope 5).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum, IntFlag

from touchcell.drivers.core.errors import DeviceFault, FaultClass, Remedy


class RobotMode(IntEnum):
    """State of the arm's power and brakes."""

    NO_CONTROLLER = -1
    DISCONNECTED = 0
    CONFIRM_SAFETY = 1
    BOOTING = 2
    POWER_OFF = 3
    POWER_ON = 4
    IDLE = 5
    BACKDRIVE = 6
    RUNNING = 7
    UPDATING_FIRMWARE = 8


class RuntimeState(IntEnum):
    """State of the program on the controller."""

    STOPPING = 0
    STOPPED = 1
    PLAYING = 2
    PAUSING = 3
    PAUSED = 4
    RESUMING = 5


class SafetyMode(IntEnum):
    """State of the safety system."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9
    VALIDATE_JOINT_ID = 10
    UNDEFINED_SAFETY_MODE = 11
    AUTOMATIC_MODE_SAFEGUARD_STOP = 12
    SYSTEM_THREE_POSITION_ENABLING_STOP = 13


class SafetyBits(IntFlag):
    """``safety_status_bits``: same content as the mode; both are read, because either may be late."""

    NORMAL_MODE = 1 << 0
    REDUCED_MODE = 1 << 1
    PROTECTIVE_STOPPED = 1 << 2
    RECOVERY_MODE = 1 << 3
    SAFEGUARD_STOPPED = 1 << 4
    SYSTEM_EMERGENCY_STOPPED = 1 << 5
    ROBOT_EMERGENCY_STOPPED = 1 << 6
    EMERGENCY_STOPPED = 1 << 7
    VIOLATION = 1 << 8
    FAULT = 1 << 9
    STOPPED_DUE_TO_SAFETY = 1 << 10


@dataclass(frozen=True, slots=True)
class FaultEntry:
    """Fault class, remedy and hint of a vendor state that is a fault."""

    name: str
    fault_class: FaultClass
    needs: Remedy
    hint: str


_EMERGENCY = "release the emergency stop at the robot, then power on and recover"

SAFETY_FAULTS: Mapping[SafetyMode, FaultEntry] = {
    SafetyMode.PROTECTIVE_STOP: FaultEntry(
        "protective stop",
        FaultClass.CONTACT,
        Remedy.RECOVER,
        "check what the arm hit or why it was too fast; recover unlocks it, at least 5 s after the stop",
    ),
    SafetyMode.RECOVERY: FaultEntry(
        "recovery mode",
        FaultClass.SAFETY_STOP,
        Remedy.OPERATOR,
        "the arm is outside its safety limits: move it back by hand from the pendant",
    ),
    SafetyMode.SAFEGUARD_STOP: FaultEntry(
        "safeguard stop", FaultClass.SAFETY_STOP, Remedy.OPERATOR, "close the guard and reset it, then recover"
    ),
    SafetyMode.SYSTEM_EMERGENCY_STOP: FaultEntry(
        "system emergency stop", FaultClass.SAFETY_STOP, Remedy.OPERATOR, _EMERGENCY
    ),
    SafetyMode.ROBOT_EMERGENCY_STOP: FaultEntry(
        "robot emergency stop", FaultClass.SAFETY_STOP, Remedy.OPERATOR, _EMERGENCY
    ),
    SafetyMode.VIOLATION: FaultEntry(
        "safety violation",
        FaultClass.SAFETY_STOP,
        Remedy.POWER_CYCLE,
        "read the log on the pendant, restart its safety",
    ),
    SafetyMode.FAULT: FaultEntry(
        "safety fault", FaultClass.INTERNAL, Remedy.SERVICE, "read the log on the pendant, restart its safety"
    ),
    SafetyMode.VALIDATE_JOINT_ID: FaultEntry(
        "joint identity not validated", FaultClass.CONFIGURATION, Remedy.SERVICE, "validate the joints on the pendant"
    ),
    SafetyMode.UNDEFINED_SAFETY_MODE: FaultEntry(
        "undefined safety mode", FaultClass.INTERNAL, Remedy.POWER_CYCLE, "restart the controller"
    ),
    SafetyMode.AUTOMATIC_MODE_SAFEGUARD_STOP: FaultEntry(
        "automatic mode safeguard stop", FaultClass.SAFETY_STOP, Remedy.OPERATOR, "close the guard, then recover"
    ),
    SafetyMode.SYSTEM_THREE_POSITION_ENABLING_STOP: FaultEntry(
        "three-position enabling stop",
        FaultClass.SAFETY_STOP,
        Remedy.OPERATOR,
        "hold the enabling device, then recover",
    ),
}
"""Every safety mode except NORMAL and REDUCED, in which the arm may move."""

_MODE_OF_BIT: Mapping[SafetyBits, SafetyMode] = {
    SafetyBits.FAULT: SafetyMode.FAULT,
    SafetyBits.VIOLATION: SafetyMode.VIOLATION,
    SafetyBits.ROBOT_EMERGENCY_STOPPED: SafetyMode.ROBOT_EMERGENCY_STOP,
    SafetyBits.SYSTEM_EMERGENCY_STOPPED: SafetyMode.SYSTEM_EMERGENCY_STOP,
    SafetyBits.EMERGENCY_STOPPED: SafetyMode.ROBOT_EMERGENCY_STOP,
    SafetyBits.PROTECTIVE_STOPPED: SafetyMode.PROTECTIVE_STOP,
    SafetyBits.SAFEGUARD_STOPPED: SafetyMode.SAFEGUARD_STOP,
    SafetyBits.RECOVERY_MODE: SafetyMode.RECOVERY,
    SafetyBits.STOPPED_DUE_TO_SAFETY: SafetyMode.UNDEFINED_SAFETY_MODE,
}


def safety_fault(device: str, mode: SafetyMode, bits: int) -> DeviceFault | None:
    """Return the fault that the safety system reports, or None while the arm may move. The mode is checked first."""
    entry = SAFETY_FAULTS.get(mode)
    if entry is None:
        mode = next((found for bit, found in _MODE_OF_BIT.items() if bits & bit), mode)
        entry = SAFETY_FAULTS.get(mode)
    if entry is None:
        return None
    return DeviceFault(
        device,
        entry.name,
        vendor_code=f"safety_mode {int(mode)}",
        fault_class=entry.fault_class,
        needs=entry.needs,
        hint=entry.hint,
    )


def power_fault(device: str, mode: RobotMode) -> DeviceFault | None:
    """Return the fault of an arm in ``mode``, or None if it is powered with its brakes released."""
    if mode is RobotMode.RUNNING:
        return None
    return DeviceFault(
        device,
        f"arm is in mode {mode.name}, not RUNNING",
        vendor_code=f"robot_mode {int(mode)}",
        fault_class=FaultClass.SAFETY_STOP,
        needs=Remedy.OPERATOR,
        hint="see the pendant; power on and release the brakes",
    )


def program_fault(device: str, state: RuntimeState) -> DeviceFault | None:
    """Return the fault of a control program in ``state``, or None if it is playing."""
    if state in (RuntimeState.PLAYING, RuntimeState.RESUMING):
        return None
    return DeviceFault(
        device,
        f"control program is {state.name}",
        vendor_code=f"runtime_state {int(state)}",
        fault_class=FaultClass.MOTION,
        needs=Remedy.RECOVER,
        hint="stopped from the pendant, by the safety system, or by its watchdog because the host was silent",
    )
