"""An emulated Franka controller: the Franka Control Interface, version 10, on TCP 1337 and UDP at 1 kHz.

Faithful in what libfranka checks: handshake, model, motions and their outcomes, modes, reflexes, recovery, lost
packets.
The hand is on TCP 1338. Not emulated: dynamics of motion generators, contact, the braking of a reflex (it stops at
once), Desk. While this process
oversleeps its clock stands still, and runs a third faster afterwards: a busy machine slows the robot down for a moment
but does not make it jump.
"""

from __future__ import annotations

import argparse
import asyncio
import select
import socket
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, ClassVar

import numpy as np

from touchcell.drivers.core.errors import CorruptMessage
from touchcell.drivers.franka.emulator.arm import EmulatedArm, Reflex, urdf
from touchcell.drivers.franka.emulator.codec import (
    PORT,
    VERSION,
    Controller,
    Generator,
    Mode,
    MotionCommand,
    MoveStatus,
    RecoveryStatus,
    Request,
    RequestMessage,
    RobotState,
    SetterStatus,
    connect_reply,
    decode_command,
    decode_connect,
    decode_move,
    doubles,
    encode_reply,
    split_requests,
)
from touchcell.drivers.franka.emulator.gripper import EmulatedHand
from touchcell.drivers.franka.errors import BY_NAME, ERRORS
from touchcell.errors import ConfigError
from touchcell.testing.emulation.base import CommandOnset, Emulator
from touchcell.testing.emulation.ticker import Tick, Ticker

_PERIOD_NS = 1_000_000
_LOST_LIMIT = 20
_RESTART_S = 0.2
_LINK_FAULTS = frozenset({"unplug", "drop", "drop_states", "delay", "corrupt"})
_INDEX = {error.name: index for index, error in enumerate(ERRORS)}
_POWER_OR_MODE = frozenset({Request.MOVE, Request.SET_GUIDING_MODE, Request.AUTOMATIC_ERROR_RECOVERY})


class FrankaEmulator(Emulator):
    """Emulator of one arm with its controller.

    Args:
        host: address to bind; the port is fixed by libfranka.
        start_deg: joint angles at which it begins.
        patience_s: how long the time stands still for a moving client that has not answered the last state.
    """

    faults: ClassVar[Mapping[str, str]] = {
        "pause": "the controller freezes: nothing is sent, read or moved",
        "unplug": "the cable is unplugged: nothing passes, the controller keeps running",
        "drop": "lose the next VALUE command packets; 20 in a row are a communication_constraints_violation",
        "drop_states": "lose the next VALUE state packets",
        "delay": "deliver each state VALUE seconds late",
        "corrupt": "truncate the next VALUE state packets",
        "out_of_order": "send VALUE old states again, each after a newer one",
        "nan": "fill the next VALUE states with NaN",
        "reflex": "stop with the error named by VALUE",
        "user_stop": "the user stop button is pressed",
        "locked": "the joints are locked in Desk",
        "external_wrench": "external wrench VALUE [fx fy fz tx ty tz] N, N m on the end effector along base axes",
        "fci_off": "the control interface is not activated in Desk: connections are refused",
        "version": "the controller speaks version VALUE of the interface",
        "other_client": "another client is connected",
        "slow_recovery": "error recovery takes VALUE seconds",
        "guiding": "the arm is guided by hand",
        "object": "an object of this width, m, is between the fingers of the hand",
        "no_hand": "the hand is not connected: its port refuses",
        "restart": "drop the client and return after a fifth of a second with the clock at zero",
    }

    def __init__(self, host: str, start_deg: Sequence[float] | None = None, *, patience_s: float = 0.0) -> None:
        super().__init__()
        self._host = host
        self._arm = EmulatedArm() if start_deg is None else EmulatedArm(q=np.radians(start_deg))
        self._hand = EmulatedHand(host)
        self._state = RobotState(message_id=1000)
        self._counts = dict.fromkeys(
            ("requests", "energising", "commands", "states", "bad_messages", "late", "reflexes"), 0
        )
        self._received: dict[str, int] = {}
        self._old_states: deque[bytes] = deque(maxlen=5)
        self._answered: deque[bool] = deque(maxlen=100)
        self._listener: socket.socket | None = None
        self._client: socket.socket | None = None
        self._udp: socket.socket | None = None
        self._client_udp: tuple[str, int] | None = None
        self._buffer = b""
        self._move_id: int | None = None
        self._first_command_seen = False
        self._lost = 0
        self._last_command_ms: int | None = None
        self._onset = CommandOnset()
        self._at_last_command: list[float] | None = None
        self._reflex_detail = ""
        self._patience_s = patience_s
        self._answers = True
        self._ticker: Ticker | None = None

    async def start(self) -> None:
        self._listen()
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((self._host, 0))
        self._udp.setblocking(False)
        await self._hand.start()
        self._describe_tool()
        self.publish_joints(self._arm.q)
        self._ticker = Ticker(_PERIOD_NS, self._tick, waits=self._patience_s > 0.0)

    async def stop(self) -> None:
        if self._ticker is not None:
            self._ticker.close()
        self._drop_client()
        self._stop_listening()
        self._hand.stop()
        if self._udp is not None:
            self._udp.close()

    def state(self) -> dict[str, Any]:
        arm, state = self._arm, self._state
        return {
            "position_m": arm.T_base_ee[:3, 3].tolist(),
            "T_base_ee": arm.T_base_ee.tolist(),
            "F_T_EE": (arm.F_T_NE @ arm.NE_T_EE).tolist(),
            "twist": (arm.J @ arm.dq).tolist(),
            "q": arm.q.tolist(),
            "dq": arm.dq.tolist(),
            "mode": state.mode.name.lower(),
            "generator": state.generator.name.lower(),
            "moving": bool(np.abs(arm.dq).max() > 1e-9),
            "energised": state.mode is not Mode.OTHER,
            "errors": self._error_names(state.errors),
            "last_errors": self._error_names(state.reflex_reason),
            "reflex_detail": self._reflex_detail,
            "connected": self._client is not None,
            "watchdog_s": _LOST_LIMIT * 1e-3,
            "time_ms": state.message_id,
            "t_s": state.message_id * 1e-3,
            "command_onset_ns": self._onset.t_ns,
            "last_command_ms": self._last_command_ms,
            "at_last_command_m": self._at_last_command,
            "hand_width_m": self._hand.width_m,
            "hand_is_grasped": self._hand.is_grasped,
            "force_threshold": arm.force_threshold.tolist(),
            "received": self._received,
            "active": self.active,
            **self._counts,
        }

    def begin(self, fault: str, value: Any = True) -> None:
        if fault == "reflex" and value not in BY_NAME:
            raise ConfigError(
                f"unknown error {value!r}", key="value", value=value, hint="one of touchcell.drivers.franka.errors"
            )
        if fault == "external_wrench" and (np.shape(value) != (6,) or not np.isfinite(value).all()):
            raise ConfigError("a wrench is six finite numbers", key="value", value=value)
        super().begin(fault, value)

    def on_fault(self, fault: str, value: Any) -> None:
        if fault == "reflex":
            del self.active["reflex"]
            self._reflex(value)
        elif fault == "user_stop":
            self._finish_move(MoveStatus.PREEMPTED_BY_SAFETY, Mode.USER_STOPPED)
        elif fault == "locked":
            self._finish_move(MoveStatus.PREEMPTED_BY_SAFETY, Mode.OTHER)
        elif fault == "guiding":
            self._finish_move(MoveStatus.PREEMPTED_BY_SAFETY, Mode.GUIDING)
        elif fault == "fci_off":
            self._stop_listening()
        elif fault == "external_wrench":
            self._arm.wrench = np.array(value, dtype=np.float64)
        elif fault == "object":
            self._hand.object_m = float(value)
        elif fault == "no_hand":
            self._hand.stop()
        elif fault == "restart":
            del self.active["restart"]
            self._restart()

    def on_clear(self, fault: str) -> None:
        if fault in ("user_stop", "locked", "guiding"):
            self._state.mode = Mode.IDLE
        elif fault == "fci_off":
            self._listen()
        elif fault == "external_wrench":
            self._arm.wrench = np.zeros(6)
        elif fault == "object":
            self._hand.object_m = None
        elif fault == "no_hand":
            asyncio.get_running_loop().create_task(self._hand.start())

    def _listen(self) -> None:
        listener = socket.socket()
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((self._host, PORT))
        listener.listen(1)
        listener.setblocking(False)
        asyncio.get_running_loop().add_reader(listener, self._accept)
        self._listener = listener

    def _stop_listening(self) -> None:
        if self._listener is not None:
            asyncio.get_running_loop().remove_reader(self._listener)
            self._listener.close()
            self._listener = None

    def _restart(self) -> None:
        self._drop_client()
        self._stop_listening()
        self._state.message_id = 0
        self._clear_errors()
        self._move_id = None
        self._end_motion(Mode.IDLE)
        asyncio.get_running_loop().call_later(_RESTART_S, self._listen)

    def _accept(self) -> None:
        assert self._listener is not None
        client, _ = self._listener.accept()
        # The previous client may have disconnected since the last tick.
        self._read_requests()
        if self._client is not None or "other_client" in self.active:
            # The controller serves one client at a time.
            client.close()
            return
        client.setblocking(False)
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client, self._buffer = client, b""

    def _drop_client(self) -> None:
        # A motion continues until its commands have been missing for long enough.
        if self._client is not None:
            self._client.close()
            self._client, self._client_udp = None, None

    def _tick(self, tick: Tick) -> None:
        if "pause" in self.active:
            return
        self._counts["late"] += tick.late
        self._coast(tick.coasted)
        self._state.message_id += 1
        if "unplug" not in self.active:
            self._read_requests()
        self._hand.forgets = "unplug" in self.active
        self._hand.step(_PERIOD_NS * 1e-9)
        self._await_answer()
        command = self._read_command()
        if self._move_id is not None:
            self._advance(command)
        self.publish_joints(self._arm.q)
        self._send_state()

    def _read_requests(self) -> None:
        if self._client is None:
            return
        try:
            data = self._client.recv(65536)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self._drop_client()
            return
        try:
            messages, self._buffer = split_requests(self._buffer + data)
            for message in messages:
                self._serve(message)
        except CorruptMessage:
            self._counts["bad_messages"] += 1
            self._drop_client()

    def _await_answer(self) -> None:
        """Let the time stand still until a moving client has answered the last state, where that is wished."""
        # Until its first command a client only reads states, for as long as its motion takes to begin.
        if self._patience_s <= 0.0 or self._move_id is None or not self._first_command_seen:
            return
        if _LINK_FAULTS & self.active.keys():
            return
        assert self._udp is not None
        # A client that has missed one answer is waited for no more until it answers again.
        deadline_s = time.monotonic() + (self._patience_s if self._answers else 0.0)
        self._answers = False
        # One that is gone will not answer.
        while self._move_id is not None and self._client is not None and not self._answers:
            ready, _, _ = select.select([self._udp, self._client], [], [], max(deadline_s - time.monotonic(), 0.0))
            self._answers = self._udp in ready
            if not ready:
                return
            if not self._answers:
                self._read_requests()

    def _read_command(self) -> MotionCommand | None:
        assert self._udp is not None
        newest = None
        while True:
            try:
                datagram, _ = self._udp.recvfrom(2048)
            except OSError:
                return newest
            if "unplug" in self.active or self.spend("drop"):
                continue
            try:
                command = decode_command(datagram)
            except CorruptMessage:
                self._counts["bad_messages"] += 1
                continue
            self._counts["commands"] += 1
            if newest is None or command.message_id > newest.message_id:
                newest = command

    def _serve(self, message: RequestMessage) -> None:
        request, command_id, payload = message
        self._counts["requests"] += 1
        self._counts["energising"] += request in _POWER_OR_MODE
        self._received[request.name.lower()] = self._received.get(request.name.lower(), 0) + 1
        if request is Request.CONNECT:
            version, port = decode_connect(payload)
            assert self._client is not None
            self._client_udp = (self._client.getpeername()[0], port)
            spoken = int(self.active.get("version", VERSION))
            self._reply(connect_reply(command_id, version == spoken, spoken))
        elif request is Request.MOVE:
            self._begin_move(command_id, payload)
        elif request is Request.STOP_MOVE:
            if self._move_id is not None:
                self._finish_move(MoveStatus.PREEMPTED, Mode.IDLE)
            self._reply(encode_reply(request, command_id, SetterStatus.SUCCESS))
        elif request is Request.AUTOMATIC_ERROR_RECOVERY:
            delay_s = float(self.active.get("slow_recovery", 0.0))
            if delay_s > 0.0:
                asyncio.get_running_loop().call_later(delay_s, self._finish_recovery, command_id)
            else:
                # Within the tick: the state that follows the reply has no errors, on which clients rely.
                self._finish_recovery(command_id)
        elif request is Request.GET_ROBOT_MODEL:
            self._reply(encode_reply(request, command_id, SetterStatus.SUCCESS, urdf().encode()))
        else:
            self._reply(encode_reply(request, command_id, self._set(request, payload)))

    def _reply(self, reply: bytes) -> None:
        if self._client is not None:
            # The next read notices a client that has disconnected.
            with suppress(OSError):
                self._client.sendall(reply)

    def _begin_move(self, command_id: int, payload: bytes) -> None:
        controller, generator = decode_move(payload)
        if self._state.mode in (Mode.USER_STOPPED, Mode.OTHER):
            status = MoveStatus.REJECTED_BY_SAFETY
        elif self._state.mode is not Mode.IDLE:
            status = MoveStatus.NOT_POSSIBLE
        elif generator is Generator.NONE and controller is not Controller.EXTERNAL:
            status = MoveStatus.INVALID_ARGUMENT
        elif not self._arm.begin(generator, self._state.message_id, by_torque=controller is Controller.EXTERNAL):
            status = MoveStatus.SINGULAR_START
        else:
            status = MoveStatus.MOTION_STARTED
            self._move_id = command_id
            self._first_command_seen, self._lost = False, 0
            self._answered.clear()
            self._state.generator, self._state.controller, self._state.mode = generator, controller, Mode.MOVE
            self._state.reflex_reason[:] = bytes(len(ERRORS))
        self._reply(encode_reply(Request.MOVE, command_id, status))

    def _finish_recovery(self, command_id: int) -> None:
        self._reply(encode_reply(Request.AUTOMATIC_ERROR_RECOVERY, command_id, self._recover()))

    def _recover(self) -> RecoveryStatus:
        if self._state.mode in (Mode.USER_STOPPED, Mode.OTHER):
            return RecoveryStatus.REJECTED_BY_SAFETY
        if self._state.mode is not Mode.REFLEX:
            return RecoveryStatus.SUCCESS
        self._clear_errors()
        self._state.mode = Mode.IDLE
        return RecoveryStatus.SUCCESS

    def _set(self, request: Request, payload: bytes) -> SetterStatus:
        if self._move_id is not None:
            return SetterStatus.NOT_POSSIBLE
        if request is Request.SET_GUIDING_MODE:
            return SetterStatus.SUCCESS
        values = doubles(payload)
        if not np.isfinite(values).all():
            return SetterStatus.INVALID_ARGUMENT
        if request is Request.SET_COLLISION_BEHAVIOR:
            nominal = values[40:]
            self._arm.contact_threshold, self._arm.force_threshold = nominal[:6].copy(), nominal[6:].copy()
        elif request is Request.SET_NE_TO_EE:
            self._arm.NE_T_EE = values.reshape(4, 4).T.copy()
            self._describe_tool()
        elif request is Request.SET_EE_TO_K:
            self._arm.EE_T_K = values.reshape(4, 4).T.copy()
            self._describe_tool()
        elif request is Request.SET_LOAD:
            self._state["m_load"], self._state["F_x_Cload"], self._state["I_load"] = values[0], values[1:4], values[4:]
        return SetterStatus.SUCCESS

    def _describe_tool(self) -> None:
        arm, state = self._arm, self._state
        arm.refresh()
        state["F_T_NE"], state["NE_T_EE"] = arm.F_T_NE.T.ravel(), arm.NE_T_EE.T.ravel()
        state["F_T_EE"], state["EE_T_K"] = (arm.F_T_NE @ arm.NE_T_EE).T.ravel(), arm.EE_T_K.T.ravel()
        state["m_ee"] = 0.73
        state["O_ddP_O"] = (0.0, 0.0, -9.81)

    def _advance(self, command: MotionCommand | None) -> None:
        self._answered.append(command is not None)
        if command is None:
            self._lost += self._first_command_seen
            if self._lost >= _LOST_LIMIT:
                self._reflex("communication_constraints_violation")
                return
        else:
            self._lost, self._first_command_seen = 0, True
            self._last_command_ms = self._state.message_id
            self._onset.note("arm", (command.q, command.O_dP_EE))
            self._at_last_command = self._arm.T_base_ee[:3, 3].tolist()
        try:
            self._arm.step(command, _PERIOD_NS * 1e-9)
        except Reflex as reflex:
            self._reflex(reflex.name, reflex.detail)
            return
        if command is not None and (command.finished or command.torque_finished):
            self._finish_move(MoveStatus.SUCCESS, Mode.IDLE)

    def _coast(self, periods: int) -> None:
        """Move on for periods in which this process did not run; that no command came is not the client's fault."""
        self._state.message_id += periods
        try:
            for _ in range(periods if self._move_id is not None else 0):
                self._arm.step(None, _PERIOD_NS * 1e-9)
        except Reflex as reflex:
            self._reflex(reflex.name, reflex.detail)

    def _reflex(self, name: str, detail: str = "") -> None:
        flag = _INDEX[name]
        self._reflex_detail = detail
        self._counts["reflexes"] += 1
        self._state.errors[flag] = self._state.reflex_reason[flag] = 1
        self._finish_move(MoveStatus.REFLEX_ABORTED, Mode.REFLEX)

    def _finish_move(self, status: MoveStatus, mode: Mode) -> None:
        if self._move_id is not None:
            self._reply(encode_reply(Request.MOVE, self._move_id, status))
            self._move_id = None
        self._end_motion(mode)

    def _end_motion(self, mode: Mode) -> None:
        self._arm.begin(Generator.IDLE)
        self._state.generator, self._state.controller, self._state.mode = Generator.IDLE, Controller.OTHER, mode

    def _clear_errors(self) -> None:
        self._state.errors[:] = bytes(len(ERRORS))

    def _send_state(self) -> None:
        if self._client_udp is None or "unplug" in self.active:
            return
        self._measure()
        datagram = self._state.encode()
        if self.spend("drop_states"):
            return
        if self.spend("corrupt"):
            datagram = datagram[:-7]
        if delay_s := float(self.active.get("delay", 0.0)):
            asyncio.get_running_loop().call_later(delay_s, self._send, datagram)
            return
        self._send(datagram)
        if self._old_states and self.spend("out_of_order"):
            self._send(self._old_states[0])
        self._old_states.append(datagram)

    def _send(self, datagram: bytes) -> None:
        if self._udp is not None and self._client_udp is not None:
            self._counts["states"] += 1
            self._udp.sendto(datagram, self._client_udp)

    def _measure(self) -> None:
        arm, state = self._arm, self._state
        pose = arm.T_base_ee.T.ravel()
        for name in ("O_T_EE", "O_T_EE_d", "O_T_EE_c"):
            state[name] = pose
        for name in ("q", "q_d", "theta"):
            state[name] = arm.q
        for name in ("dq", "dq_d", "dtheta"):
            state[name] = arm.dq
        state["tau_J"] = state["tau_J_d"] = arm.tau
        state["O_dP_EE_c"] = state["O_dP_EE_d"] = arm.twist_c
        for name in ("elbow", "elbow_d", "elbow_c"):
            state[name] = (arm.q[2], -1.0 if arm.q[3] < 0 else 1.0)
        # Franka counts the wrench of the arm on the world as positive.
        state["O_F_ext_hat_K"] = -arm.wrench
        R = arm.T_base_ee[:3, :3] @ arm.EE_T_K[:3, :3]
        state["K_F_ext_hat_K"] = -np.concatenate([R.T @ arm.wrench[:3], R.T @ arm.wrench[3:]])
        state["tau_ext_hat_filtered"] = -arm.J.T @ arm.wrench
        state["cartesian_contact"] = np.abs(arm.wrench) > arm.contact_threshold
        state["cartesian_collision"] = np.abs(arm.wrench) > arm.force_threshold
        state.success_rate = sum(self._answered) / len(self._answered) if self._move_id and self._answered else 0.0
        if self.spend("nan"):
            for name in ("O_T_EE", "q", "dq", "O_F_ext_hat_K"):
                state[name] = np.nan

    @staticmethod
    def _error_names(flags: bytearray) -> list[str]:
        return [error.name for error, flag in zip(ERRORS, flags, strict=True) if flag]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the command-line arguments."""
    parser.add_argument("--host", default="127.0.0.1", help="address to bind; the port is 1337")
    parser.add_argument("--start-deg", type=float, nargs=7, metavar="DEG", help="joint angles at which it begins")
    parser.add_argument(
        "--patience", type=float, default=0.0, metavar="S", help="let time stand still for a client that answers late"
    )


def build(arguments: argparse.Namespace) -> FrankaEmulator:
    """Build the emulator; it is not started yet."""
    return FrankaEmulator(arguments.host, arguments.start_deg, patience_s=arguments.patience)
