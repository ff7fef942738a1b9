"""Read the state of a Franka arm in a thread.

franky's ``state`` waits for the next packet while the arm is at rest, for a whole second if the arm is frozen; a
program that controls a second arm cannot wait for that. And a motion that aborts is silent until polled: the thread
polls.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.errors import CorruptMessage, DeviceError, DeviceGone
from touchcell.drivers.franka.errors import BY_NAME
from touchcell.geometry.types import Array
from touchcell.logs import OncePerCause

_logger = logging.getLogger(__name__)

PERIOD_S = 0.002
_BAD_IN_A_ROW = 50
_JOIN_S = 3.0


@dataclass(frozen=True, slots=True)
class Reading:
    """Content of one state packet, in SI units along base axes.

    Attributes:
        t_ns: start of the read before the one that found it: it cannot have arrived earlier, so no age is understated.
        device_ms: the controller's own time.
        T_base_tcp: (4, 4), with the end effector that is set in the controller.
        T_flange_tcp: (4, 4), that end effector.
        twist: (6,) of the tool centre point, from measured joint velocities.
        q, dq, tau: joints (7,).
        wrench: (6,) external wrench on the tool centre point.
        external_torque: (7,) external torques of the joints, the controller's filtered estimate.
        mode: franky's name of the robot mode.
        errors: names of the present errors.
        last_errors: names of the errors that ended the last motion.
        success_rate: fraction of the last 100 command packets that arrived in time.
    """

    t_ns: int
    device_ms: int
    T_base_tcp: Array
    T_flange_tcp: Array
    twist: Array
    q: Array
    dq: Array
    tau: Array
    wrench: Array
    external_torque: Array
    mode: str
    errors: tuple[str, ...]
    last_errors: tuple[str, ...]
    success_rate: float

    def is_finite(self) -> bool:
        """Return whether every number is finite."""
        poses = (self.T_base_tcp, self.T_flange_tcp)
        arrays = (*poses, self.twist, self.q, self.dq, self.tau, self.wrench, self.external_torque)
        return all(bool(np.isfinite(array).all()) for array in arrays)


class StateReader:
    """Hold the newest good reading and the last failure.

    Args:
        device: name for errors.
        franky: the vendor's module.
        robot: franky's robot, connected.
        clock: injected clock.
    """

    def __init__(self, device: str, franky: Any, robot: Any, clock: Clock) -> None:
        self._device = device
        self._franky = franky
        self._robot = robot
        self._clock = clock
        self._newest: Reading | None = None
        self._failure: DeviceError | None = None
        self._aborted: str | None = None
        self._in_motion = False
        self._polled_ns = 0
        self._bad = 0
        self._bad_in_a_row = 0
        self._losses = OncePerCause(_logger)
        self._states = 0
        self._device_ms = -1
        self._read_ns = clock.now_ns()
        self._halt = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"{device} reader", daemon=True)

    @property
    def newest(self) -> Reading | None:
        """The newest reading whose numbers are all finite."""
        return self._newest

    @property
    def failure(self) -> DeviceError | None:
        """The lost connection that ended the thread, or why no state has been readable of late; else None."""
        return self._failure

    @property
    def aborted(self) -> str | None:
        """The message with which franky aborted a motion, until ``clear_abort``."""
        return self._aborted

    @property
    def in_motion(self) -> bool:
        """Whether a motion was running at the last poll."""
        return self._in_motion

    @property
    def polled_ns(self) -> int:
        """Time of the last poll for a running motion."""
        return self._polled_ns

    @property
    def bad(self) -> int:
        """Number of states that were unreadable or not finite."""
        return self._bad

    @property
    def states(self) -> int:
        """Number of distinct states received."""
        return self._states

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Join the thread and release the robot, which disconnects when its last reference is dropped."""
        self._halt.set()
        if self._thread.is_alive():
            self._thread.join(_JOIN_S)
        self._robot = None

    def clear_abort(self) -> None:
        """Discard an aborted motion."""
        self._aborted = None

    def _run(self) -> None:
        while not self._halt.is_set():
            try:
                self._read()
            except self._franky.NetworkException as error:
                # libfranka never reconnects.
                self._failure = DeviceGone(
                    self._device, f"lost the controller: {error}", hint="disconnect and connect again"
                )
                return
            except Exception as error:
                self._count_bad(repr(error))
            self._halt.wait(PERIOD_S)

    def _read(self) -> None:
        last_ns, self._read_ns = self._read_ns, self._clock.now_ns()
        franky = self._franky
        message = None
        try:
            self._robot.poll_motion()
        except (franky.ControlException, franky.CommandException, franky.ProtocolException) as error:
            message = str(error)
        polled_ns = self._clock.now_ns()
        self._in_motion = self._robot.is_in_control
        self._polled_ns = polled_ns
        try:
            self._take(self._robot.state, last_ns)
        except franky.ProtocolException as error:
            self._count_bad(str(error))
        # Only now, so that the newest reading includes the reason of the abort.
        if message is not None:
            self._aborted = message

    def _take(self, state: Any, t_ns: int) -> None:
        device_ms = state.time.to_msec()
        if device_ms == self._device_ms:
            return
        self._device_ms = device_ms
        self._states += 1
        reading = self._convert(state, t_ns, device_ms)
        if not reading.is_finite():
            self._count_bad("state with non-finite numbers")
            return
        if self._bad_in_a_row:
            self._bad_in_a_row = 0
            self._failure = None
            self._losses.forget()
        self._newest = reading

    def _convert(self, state: Any, t_ns: int, device_ms: int) -> Reading:
        dq = np.asarray(state.dq)
        J = self._robot.model.zero_jacobian(self._franky.Frame.EndEffector, state)
        return Reading(
            t_ns=t_ns,
            device_ms=device_ms,
            T_base_tcp=np.asarray(state.O_T_EE.matrix),
            T_flange_tcp=np.asarray(state.F_T_EE.matrix),
            twist=np.asarray(J @ dq),
            q=np.asarray(state.q),
            dq=dq,
            tau=np.asarray(state.tau_J),
            # Franka counts the wrench of the arm on the world as positive.
            wrench=-np.asarray(state.O_F_ext_hat_K),
            external_torque=np.asarray(state.tau_ext_hat_filtered),
            mode=state.robot_mode.name,
            errors=_present(state.current_errors),
            last_errors=_present(state.last_motion_errors),
            success_rate=float(state.control_command_success_rate),
        )

    def _count_bad(self, what: str) -> None:
        self._bad += 1
        self._bad_in_a_row += 1
        self._losses.warning("bad", "%s: dropped a bad state: %s", self._device, what)
        if self._bad_in_a_row >= _BAD_IN_A_ROW:
            self._failure = CorruptMessage(self._device, f"{_BAD_IN_A_ROW} consecutive bad states, the last: {what}")


def _present(errors: Any) -> tuple[str, ...]:
    return tuple(name for name in BY_NAME if getattr(errors, name))
