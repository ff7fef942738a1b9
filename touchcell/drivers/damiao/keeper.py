"""``python -m touchcell.drivers.damiao.keeper``: owns the bus of an arm without brakes, and outlives its client.

It passes frames between one client and the bus. When the client has died, or has not commanded for ``hold_after_s``, it
holds the arm where the last command put it; ``lower_after_s`` later it lowers the arm along gravity, no faster than
``lower_speed_mm_s``, takes the stiffness away slowly, damps until nothing moves, disables the motors and ends. A client
that only paused finds its arm held. What happens when this process itself is killed is what the motors' own timeout
gives: they let go.

The configuration is one JSON object on standard input: ``socket``, ``config`` (of the driver). Standard output says
"ready".
"""

from __future__ import annotations

import gc
import json
import os
import select
import socket
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from enum import Enum
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.drivers.core.can_packets import FRAME_SIZES, LONGEST, pack, unpack
from touchcell.drivers.core.errors import CodecError, DeviceError
from touchcell.drivers.damiao import codec
from touchcell.drivers.damiao.codec import MitCommand, Ranges, Register
from touchcell.drivers.damiao.descent import Descent
from touchcell.drivers.damiao.driver import DamiaoCanConfig, open_bus
from touchcell.drivers.damiao.fade import Fade
from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.geometry.types import Array

BYE: Final = b"B"
OFFSETS: Final = b"O"
FAILED: Final = b"E"
"""First bytes of packets that are no frames: an orderly end, the joints' offsets (rad, JSON), a failed transfer."""

_REST_S = 2.0
_LONGEST_DESCENT_S = 30.0
_PRIORITY = 50
_MOST_FRAMES = 64


class Phase(Enum):
    """What the keeper does."""

    PASSING = "passing"
    HOLDING = "holding"
    LOWERING = "lowering"
    FADING = "fading"
    ENDED = "ended"


class Keeper:
    """The frames, the clock and the motion of one arm.

    Args:
        config: of the driver.
        bus: python-can bus.
        listener: bound and listening socket for the client.
    """

    def __init__(self, config: DamiaoCanConfig, bus: Any, listener: socket.socket) -> None:
        self._config = config
        self._period_s = 1.0 / config.rate_hz
        self._bus = bus
        self._listener = listener
        self._client: socket.socket | None = None
        self._chain = SerialChain(config.describe(), config.tool, config.gravity_m_s2)
        self._direction = np.array([motor.direction for motor in config.motors], dtype=np.float64)
        self._offset = np.deg2rad([motor.offset_deg for motor in config.motors])
        n = len(config.motors)
        self._index_of = {motor.esc_id: index for index, motor in enumerate(config.motors)}
        self._answers_of = {motor.mst_id: index for index, motor in enumerate(config.motors)}
        self._scales: list[dict[int, float]] = [{} for _ in range(n)]
        self._frames: list[bytes | None] = [None] * n
        self._q = np.zeros(n)
        self._enabled = np.zeros(n, dtype=bool)
        self._phase = Phase.PASSING
        self._since_s = 0.0
        self._commanded_s = time.monotonic()
        self._descent: Descent | None = None
        self._fade: Fade | None = None
        self._held: Array | None = None
        self._rested_s = 0.0
        self.latest_s = 0.0

    def run(self) -> None:
        """Pass frames and keep the arm until it is not needed any more, or the bus is gone."""
        next_s = time.monotonic()
        while self._phase is not Phase.ENDED:
            now_s = time.monotonic()
            if now_s >= next_s:
                self.latest_s = max(self.latest_s, now_s - next_s)
                self._keep(now_s)
                next_s = max(next_s + self._period_s, now_s)
            self._transfer(max(next_s - time.monotonic(), 0.0))

    def _transfer(self, timeout_s: float) -> None:
        source = self._client or self._listener
        poller = select.poll()
        poller.register(self._bus.fileno(), select.POLLIN)
        poller.register(source, select.POLLIN)
        for fd, _ in poller.poll(1e3 * timeout_s):
            if fd != source.fileno():
                self._from_bus()
            elif self._client is None:
                self._client, _ = self._listener.accept()
                self._client.setblocking(False)
            else:
                # All that waits, but never so much that holding comes late.
                for _ in range(_MOST_FRAMES):
                    if self._client is None or not self._from_client(self._client):
                        break

    def _from_bus(self) -> None:
        for _ in range(_MOST_FRAMES):
            message = self._bus.recv(0.0)
            if message is None:
                return
            if not message.is_error_frame:
                self._note_answer(message.arbitration_id, bytes(message.data))
            if self._client is not None:
                self._to_client(pack(message))

    def _from_client(self, client: socket.socket) -> bool:
        """Take one packet; return whether there was one."""
        try:
            packet = client.recv(LONGEST * 16)
        except BlockingIOError:
            return False
        except OSError:
            packet = b""
        if not packet or packet == BYE:
            client.close()
            self._client = None
            if not self._enabled.any():
                self._enter(Phase.ENDED)
            elif self._phase is Phase.PASSING:
                self._enter(Phase.HOLDING)
            return False
        if self._phase in (Phase.LOWERING, Phase.FADING):
            # It comes back too late: the arm is on its way down.
            client.close()
            self._client = None
            return False
        if packet[:1] == OFFSETS and len(packet) not in FRAME_SIZES:
            self._offset = np.array(json.loads(packet[1:]), dtype=np.float64)
        else:
            self._send(packet, client)
        return True

    def _send(self, packet: bytes, client: socket.socket) -> None:
        message = unpack(packet)
        self._note_command(message.arbitration_id, bytes(message.data))
        try:
            self._bus.send(message)
        except Exception as error:
            told = {"text": str(error), "code": getattr(error, "error_code", None)}
            with suppress(OSError):
                client.send(FAILED + json.dumps(told).encode())

    def _to_client(self, packet: bytes) -> None:
        assert self._client is not None
        # One that does not read loses frames, as on a real adapter; one that is gone is noticed by its end of file.
        with suppress(OSError):
            self._client.send(packet)

    def _note_command(self, number: int, data: bytes) -> None:
        index = self._index_of.get(number)
        if index is None:
            return
        self._commanded_s = time.monotonic()
        if self._phase is Phase.HOLDING:
            self._phase = Phase.PASSING
        if data == codec.DISABLE:
            self._frames[index] = None
            self._enabled[index] = False
        elif data[:7] != codec.ENABLE[:7]:
            self._frames[index] = data

    def _note_answer(self, number: int, data: bytes) -> None:
        index = self._answers_of.get(number)
        if index is None:
            return
        esc_id = self._config.motors[index].esc_id
        for register in (Register.PMAX, Register.VMAX, Register.TMAX):
            with suppress(CodecError):
                reply = codec.decode_register_reply(data, esc_id, register)
                if reply is not None:
                    self._scales[index][register] = float(reply.value)
                    return
        ranges = self._ranges(index)
        if ranges is None or codec.is_register_reply(data, esc_id):
            return
        with suppress(CodecError):
            feedback = codec.decode_feedback(data, esc_id, ranges)
            self._enabled[index] = feedback.status == codec.ENABLED
            self._q[index] = self._direction[index] * feedback.q + self._offset[index]

    def _ranges(self, index: int) -> Ranges | None:
        scale = self._scales[index]
        if len(scale) < len((Register.PMAX, Register.VMAX, Register.TMAX)):
            return None
        return Ranges(scale[Register.PMAX], scale[Register.VMAX], scale[Register.TMAX])

    def _enter(self, phase: Phase) -> None:
        self._phase = phase
        self._since_s = time.monotonic()
        late = f"its latest cycle came {1e3 * self.latest_s:.0f} ms late"
        print(f"{phase.value}; enabled {self._enabled.tolist()}; {late}", file=sys.stderr, flush=True)
        if phase is Phase.HOLDING:
            self._held = self._setpoint()

    def _keep(self, now_s: float) -> None:
        paused_s = now_s - self._commanded_s
        if self._phase is Phase.PASSING and self._enabled.any() and paused_s > self._config.watchdog_s * _PATIENCE:
            self._enter(Phase.HOLDING)
        if self._phase is Phase.HOLDING:
            assert self._held is not None
            self._command(self._held, 1.0)
            if now_s - self._since_s > self._config.lower_after_s:
                self._descent = Descent(self._chain, self._held, 1e-3 * self._config.lower_speed_mm_s)
                self._enter(Phase.LOWERING)
        elif self._phase is Phase.LOWERING:
            self._lower(now_s)
        elif self._phase is Phase.FADING:
            self._let_go(now_s)

    def _setpoint(self) -> Array:
        """Return the joint angles (n,) that the client commanded last; measured ones where it commanded none."""
        q = self._q.copy()
        for index, frame in enumerate(self._frames):
            ranges = self._ranges(index)
            if frame is not None and ranges is not None:
                with suppress(CodecError):
                    commanded = codec.decode_mit(frame, ranges).q
                    q[index] = self._direction[index] * commanded + self._offset[index]
        return q

    def _lower(self, now_s: float) -> None:
        assert self._descent is not None
        q = self._descent.step(self._q, self._period_s)
        self._command(q, 1.0)
        self._rested_s = self._rested_s + self._period_s if self._descent.rests else 0.0
        if self._rested_s > _REST_S or now_s - self._since_s > _LONGEST_DESCENT_S:
            self._held = q
            self._fade = Fade(self._q, now_s)
            self._enter(Phase.FADING)

    def _let_go(self, now_s: float) -> None:
        assert self._held is not None
        assert self._fade is not None
        share = self._fade.share(self._q, now_s)
        if share is not None:
            self._command(self._held, share)
            return
        self._put([codec.DISABLE if on else None for on in self._enabled])
        self._enter(Phase.ENDED)

    def _command(self, q: Array, share: float) -> None:
        """Command every enabled motor to ``q`` (n,) rad, with a share of its stiffness and of gravity's torque."""
        tau = share * self._chain.gravity_torques(q)
        frames: list[bytes | None] = []
        for index, motor in enumerate(self._config.motors):
            ranges = self._ranges(index)
            if not self._enabled[index] or ranges is None:
                frames.append(None)
                continue
            strongest = min(float(self._chain.torque[index]), ranges.torque_n_m)
            command = MitCommand(
                float(
                    np.clip(
                        self._direction[index] * (q[index] - self._offset[index]),
                        -ranges.position_rad,
                        ranges.position_rad,
                    )
                ),
                0.0,
                share * motor.kp_n_m_rad,
                # An arm that is let go sinks against as much damping as its motors have.
                motor.kd_n_m_s_rad if share == 1.0 else codec.KD_MAX,
                float(np.clip(self._direction[index] * tau[index], -strongest, strongest)),
            )
            frames.append(codec.encode_mit(command, ranges))
        self._put(frames)

    def _put(self, frames: Sequence[bytes | None]) -> None:
        import can

        for motor, data in zip(self._config.motors, frames, strict=True):
            if data is None:
                continue
            message = can.Message(
                arbitration_id=motor.esc_id,
                is_extended_id=False,
                data=data,
                is_fd=self._config.fd,
                bitrate_switch=self._config.fd,
            )
            # A frame that is refused now is sent again in the next cycle.
            with suppress(can.CanError):
                self._bus.send(message)


_PATIENCE = 0.4
"""Share of the motors' timeout after which a silent client counts as paused."""


def main() -> int:
    """Read the configuration, open bus and socket, and keep the arm; returns the exit code."""
    about = json.loads(sys.stdin.readline())
    config = DamiaoCanConfig.model_validate(about["config"])
    path = Path(about["socket"])
    try:
        bus = open_bus("keeper", config)
    except DeviceError as error:
        print(error, file=sys.stderr, flush=True)
        return 1
    path.unlink(missing_ok=True)
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(str(path))
    listener.listen(1)
    # Where it is permitted, nothing but the kernel comes before an arm that would fall.
    with suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_PRIORITY))
    gc.disable()
    print("ready", flush=True)
    try:
        Keeper(config, bus, listener).run()
    finally:
        path.unlink(missing_ok=True)
        bus.shutdown()
    return 0


if __name__ == "__main__":
    sys.exit(main())
