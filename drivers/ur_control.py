"""ur-rtde's control interface, with the parts tamed that must not be left to it.

Facts of ur-rtde 1.6.5 that shape this module (its program and client, read and run against the emulator):

- ``speedL(xd, a, time)`` does not expire: the uploaded program calls ``speedl(xd, a, t=time)`` again and again until it
  is told otherwise. ``time`` only says how soon it takes up a newer twist, so it is one control period here.
- ``setWatchdog`` stops the whole program when ``input_int_register_0`` is not written often enough. It is therefore set
  always, and proven once per activation by keeping silent until the program has stopped.
- Registers outlive the program: one that starts while ``input_int_register_0`` still says speedL moves at once. It is
  cleared before every upload.
- On a lost connection the client reconnects by itself and, where it may upload, restarts its program and repeats the
  command. So it is made without leave to upload, which is done here, once, by ``open``.
- Commands that wait for an answer wait up to 300 s (``drivers/ur_sdk.py``).
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from drivers.clock import Clock
from drivers.errors import (
    CommandRejected,
    DeviceError,
    DeviceFault,
    DeviceGone,
    FaultClass,
    Rejection,
    Remedy,
)
from drivers.ur_sdk import bounded, dashboard, retire
from geometry.types import Array

PERIOD_S = 0.002
_ANSWER_S = 1.0
_OPEN_S = 3.0
_START_S = 5.0
_TRIP_SLACK_S = 0.5
_POLL_NS = 2_000_000
_KICKS_PER_WATCHDOG_PERIOD = 4
_TOOL_TOLERANCE = 1e-6
_AT_REST = [0.0] * 6


class ControlLink:
    """One run of the control program on one controller; ``open`` starts it, ``close`` ends it, and it is used once.

    Args:
        device: name for errors.
        host: address of the controller.
        clock: the host's clock.
        watchdog_hz: slowest rate of register writes that the controller tolerates.

    Attributes:
        ttl_stops: motions that ended because their time-to-live had passed.
        trip_s: how long the watchdog took to stop the silent program when it was proven.
    """

    def __init__(self, device: str, host: str, clock: Clock, watchdog_hz: float) -> None:
        self._device = device
        self._host = host
        self._clock = clock
        self._watchdog_hz = watchdog_hz
        self._kick_ns = round(1e9 / (watchdog_hz * _KICKS_PER_WATCHDOG_PERIOD))
        self._wire = threading.RLock()
        self._control: Any = None
        self._armed = False
        self._speeding = False
        self._expires_ns: int | None = None
        self._stop_accel = 0.0
        self._operation_before: int | None = None
        self._written_ns = 0
        self.ttl_stops = 0
        self.trip_s = 0.0

    def open(self, flange_to_tcp: Array) -> None:
        """Upload the program, prove its watchdog, set the tool and read it back.

        Args:
            flange_to_tcp: pose [x y z rx ry rz], m and rotation vector.

        Raises:
            TransportTimeout, DeviceGone: the controller does not answer.
            DeviceFault: it does not start the program, stop it by its watchdog, or take the tool.
        """
        from rtde_control import RTDEControlInterface

        with self._wire:
            flags = RTDEControlInterface.FLAG_NO_WAIT
            self._control = bounded(
                self._device, "RTDE control", _OPEN_S, lambda: RTDEControlInterface(self._host, flags=flags)
            )
            self._start_program()
            self._prove_watchdog()
            self._start_program()
            wanted = flange_to_tcp.tolist()
            self._answered("setTcp", lambda control: control.setTcp(wanted))
            tool = bounded(self._device, "getTCPOffset", _ANSWER_S, self._control.getTCPOffset)
            if not np.allclose(tool, wanted, rtol=0.0, atol=_TOOL_TOLERANCE):
                raise DeviceFault(
                    self._device,
                    f"tool offset reads back as {tool}, not {wanted}",
                    fault_class=FaultClass.CONFIGURATION,
                    needs=Remedy.SERVICE,
                    hint="another client may be setting it too",
                )
            self._set_watchdog()
            self._armed = True

    def speed(self, twist_base: Array, accel: float, stop_accel: float, expires_ns: int) -> None:
        """Follow a twist until ``expires_ns``, then slow down with ``stop_accel``.

        Raises:
            CommandRejected: a joint goal is still under way, or the link has been closed.
            DeviceGone, DeviceFault: it could not be sent.
        """
        with self._wire:
            if not self._armed:
                raise CommandRejected(self._device, Rejection.MODE, "the control program has been given up")
            if self.goal_running():
                raise CommandRejected(
                    self._device, Rejection.MODE, "a joint goal is under way", hint="stop, or wait until it is at rest"
                )
            self._stop_accel = stop_accel
            self._expires_ns = expires_ns
            self._speeding = True
            self._stream("speedL", lambda control: control.speedL(twist_base.tolist(), accel, PERIOD_S))

    def halt(self, stop_accel: float) -> None:
        """Begin to slow down with ``stop_accel``, whatever is going on."""
        with self._wire:
            if not self._armed:
                return
            self._expires_ns = None
            if self.goal_running():
                self._operation_before = self._control.getAsyncOperationProgressEx().operationId()
                self._answered("stopJ", lambda control: control.stopJ(stop_accel, True) or True)
            elif self._speeding:
                self._stream("speedL", lambda control: control.speedL(_AT_REST, stop_accel, PERIOD_S))

    def move_joints(self, q: Array, speed: float, accel: float, stop_accel: float) -> None:
        """Start towards joint angles (6,) with ``speed`` rad/s and ``accel`` rad/s2; the arm must be at rest."""
        with self._wire:
            if not self._armed:
                raise CommandRejected(self._device, Rejection.MODE, "the control program has been given up")
            if self._speeding:
                # Two threads of the program may not drive the arm: its speed thread has to end first.
                self._answered("speedStop", lambda control: control.speedStop(stop_accel))
                self._speeding = False
            self._operation_before = self._control.getAsyncOperationProgressEx().operationId()
            self._answered("moveJ", lambda control: control.moveJ(q.tolist(), speed, accel, True))

    def goal_running(self) -> bool:
        """Whether a joint goal, or the stop of one, is still under way."""
        with self._wire:
            if self._operation_before is None or self._control is None:
                return False
            progress = self._control.getAsyncOperationProgressEx()
            if progress.operationId() != self._operation_before and not progress.isAsyncOperationRunning():
                self._operation_before = None
            return self._operation_before is not None

    def tick(self) -> None:
        """Stop what has expired and keep the watchdog quiet; to be called every few milliseconds."""
        # Whoever holds the wire is writing, which keeps the watchdog quiet just as well.
        if not self._wire.acquire(blocking=False):
            return
        try:
            now_ns = self._clock.now_ns()
            if not self._armed:
                return
            if self._expires_ns is not None and now_ns >= self._expires_ns:
                self.ttl_stops += 1
                self.halt(self._stop_accel)
            elif now_ns - self._written_ns >= self._kick_ns:
                self._stream("kickWatchdog", lambda control: control.kickWatchdog())
        finally:
            self._wire.release()

    def close(self) -> None:
        """End the program, so that nothing can resume it, and the connection. Never raises."""
        with self._wire:
            control, self._control = self._control, None
            self._armed = False
            if control is None:
                return
            with suppress(DeviceError), dashboard(self._device, self._host) as client:
                client.stop()
            retire(self._device, control)

    def _start_program(self) -> None:
        control = self._control
        # With the program stopped this only clears the command register.
        bounded(self._device, "clearing of the command register", _ANSWER_S, control.kickWatchdog)
        bounded(self._device, "upload", _OPEN_S, control.reuploadScript)
        self._await(
            control.isProgramRunning,
            _START_S,
            "the control program does not start",
            "see the log on the pendant; only one program can run at a time",
        )
        self._answered("kickWatchdog", lambda sdk: sdk.kickWatchdog())

    def _prove_watchdog(self) -> None:
        silent_ns = self._set_watchdog()
        self._await(
            lambda: not self._control.isProgramRunning(),
            1.0 / self._watchdog_hz + _TRIP_SLACK_S,
            f"the watchdog of {self._watchdog_hz:g} Hz does not stop a silent program",
            "do not use this controller: the arm would go on if the host died",
        )
        self.trip_s = (self._clock.now_ns() - silent_ns) * 1e-9

    def _set_watchdog(self) -> int:
        # Not _answered: the kick that follows there would be within the silence, or come too late.
        if not bounded(self._device, "setWatchdog", _ANSWER_S, lambda: self._control.setWatchdog(self._watchdog_hz)):
            raise self._refused("setWatchdog")
        self._written_ns = self._clock.now_ns()
        return self._written_ns

    def _await(self, condition: Callable[[], bool], timeout_s: float, trouble: str, hint: str) -> None:
        deadline_ns = self._clock.now_ns() + round(timeout_s * 1e9)
        while not condition():
            if (now_ns := self._clock.now_ns()) >= deadline_ns:
                raise DeviceFault(
                    self._device, trouble, fault_class=FaultClass.CONFIGURATION, needs=Remedy.OPERATOR, hint=hint
                )
            self._clock.sleep_until_ns(now_ns + _POLL_NS)

    def _answered(self, what: str, call: Callable[[Any], bool]) -> None:
        # The kick returns once the program is ready again, so that the next streamed command need not wait for it.
        control = self._control
        if not bounded(self._device, what, _ANSWER_S, lambda: call(control) and control.kickWatchdog()):
            raise self._refused(what)
        self._written_ns = self._clock.now_ns()

    def _stream(self, what: str, call: Callable[[Any], bool]) -> None:
        if not self._control.isConnected():
            raise DeviceGone(self._device, "the control connection is gone")
        try:
            sent = call(self._control)
        except RuntimeError as error:
            raise DeviceGone(self._device, f"{what}: {error}") from error
        if not sent:
            raise self._refused(what)
        self._written_ns = self._clock.now_ns()

    def _refused(self, what: str) -> DeviceFault:
        return DeviceFault(
            self._device,
            f"{what} was not taken",
            fault_class=FaultClass.MOTION,
            needs=Remedy.RECOVER,
            hint="the control program is not running; see the pendant",
        )
