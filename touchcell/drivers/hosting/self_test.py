"""Self-test of the watchdog chain: slowly moving arms have to stop when heartbeats are withheld.

Commands continue during both parts, so that the chain stops the arms, not the expiry of commands.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

import numpy as np

from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, DeviceError
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.hosting.chain import Chain
from touchcell.drivers.hosting.layouts import Cause, Reason
from touchcell.drivers.hosting.proxies import RemoteArm
from touchcell.geometry.types import Array

SPEED_M_S: Final = 1e-3
MARGIN_S: Final = 0.2
"""Time allowed for a stop beyond silence, cycles and deceleration: a vendor's controller smooths its motion, and
reports standstill with a delay (0.13 s for Franka's)."""

_SEEN_M: Final = 5e-5
_SEEN_WITHIN_S: Final = 2.0
_TTL_PERIODS: Final = 3


class SelfTestFailed(DeviceError):
    """The chain did not stop an arm as required; the cell is not activated.

    Attributes:
        link: the heartbeat that was withheld.
        declared_s: time within which all arms had to be at rest.
        measured_s: time at which the last one was at rest; None if one was not, or did not move in the first place.
    """

    def __init__(self, device: str, link: str, reason: str, declared_s: float, measured_s: float | None) -> None:
        super().__init__(
            device,
            f"self-test, {link} withheld: {reason}",
            hint="do not use this cell; docs/explanation/safety-processes.md describes the test",
        )
        self.link = link
        self.declared_s = declared_s
        self.measured_s = measured_s


@dataclass(frozen=True, slots=True)
class SelfTestResult:
    """Passed part of the self-test.

    Attributes:
        link: the heartbeat that was withheld.
        time_s: from the last heartbeat until the last arm was at rest.
        declared_s: allowed time.
    """

    link: str
    time_s: float
    declared_s: float

    def __str__(self) -> str:
        return f"self-test, {self.link} withheld: all arms at rest after {self.time_s:.3f} s ({self.declared_s:.3f} s)"


def self_test(chain: Chain) -> tuple[SelfTestResult, ...]:
    """Withhold the task's heartbeats, then the watchdog's, while every arm of an active chain moves at 1 mm/s.

    Afterwards the stop is cleared, nothing moves and all leases are released. Without arms nothing is tested.

    Raises:
        SelfTestFailed: an arm did not move, did not stop in time, or stopped for another reason.
        DeviceError: an arm cannot be moved at all.
    """
    if not chain.arms:
        return ()

    def hold_watchdog() -> None:
        chain.hold_watchdog(True)

    parts: dict[str, tuple[Reason, Callable[[], None] | None]] = {
        "the task's heartbeat": (Reason.TASK_SILENT, None),
        "the watchdog": (Reason.WATCHDOG_SILENT, hold_watchdog),
    }
    return tuple(_part(chain, link, reason, withhold) for link, (reason, withhold) in parts.items())


def declared_s(chain: Chain) -> float:
    """Return the longest time (s) from the last heartbeat until every arm is at rest from 1 mm/s."""
    cycles_s = chain.period_s / 4 + max(1.0 / group.rate_hz(1.0 / chain.period_s) for group in chain.groups)
    braking_s = max(SPEED_M_S / arm.limits.accel_m_s2 for arm in chain.arms.values())
    return chain.silence_s + cycles_s + braking_s + MARGIN_S


def _part(chain: Chain, link: str, reason: Reason, withhold: Callable[[], None] | None) -> SelfTestResult:
    arms, within_s = chain.arms, declared_s(chain)
    leases = {name: arm.acquire("self-test") for name, arm in arms.items()}
    chain.begin()
    try:
        _wait_until_all_move(chain, leases, link, within_s)
        # The last heartbeat: the withheld process is silent from here on.
        chain.beat()
        last_ns = chain.now_ns()
        if withhold is not None:
            withhold()
        cause = _wait_until_stopped(chain, leases, within_s, beats=withhold is not None)
        standing = {name: _rested_ns(chain, arm, last_ns + round(1e9 * within_s)) for name, arm in arms.items()}
    finally:
        if withhold is not None:
            chain.hold_watchdog(False)
        chain.end()
        for name, lease in leases.items():
            with suppress(DeviceError):
                arms[name].release(lease)
    for name, rested_ns in standing.items():
        if rested_ns is None:
            raise SelfTestFailed(name, link, f"not at rest within {within_s:.3f} s", within_s, None)
    time_s = (max(t_ns for t_ns in standing.values() if t_ns is not None) - last_ns) * 1e-9
    if cause is None or cause.reason is not reason:
        found = "nothing" if cause is None else cause.reason.description
        raise SelfTestFailed(
            "chain", link, f"it stopped because of {found}, not {reason.description}", within_s, time_s
        )
    chain.clear()
    for arm in arms.values():
        # A stop category that removes power ends in READY.
        if arm.state is Lifecycle.READY:
            arm.activate()
    return SelfTestResult(link, time_s, within_s)


def _wait_until_all_move(chain: Chain, leases: Mapping[str, Lease], link: str, within_s: float) -> None:
    arms = chain.arms
    started = {name: _position(arm) for name, arm in arms.items()}
    unseen, deadline_ns = set(arms), chain.now_ns() + round(1e9 * _SEEN_WITHIN_S)
    while unseen:
        if chain.now_ns() > deadline_ns:
            raise SelfTestFailed(min(unseen), link, "it was not seen to move at 1 mm/s", within_s, None)
        try:
            _cycle(chain, leases, beats=True)
        except CommandRejected as error:
            reason = f"stopped before anything was withheld: {error.message}"
            raise SelfTestFailed(error.device, link, reason, within_s, None) from error
        unseen = {
            name for name in unseen if arms[name].at_rest() or math.dist(_position(arms[name]), started[name]) < _SEEN_M
        }


def _wait_until_stopped(chain: Chain, leases: Mapping[str, Lease], within_s: float, *, beats: bool) -> Cause | None:
    """Continue commanding until the arms have been stopped; return the cause, or None after the time."""
    deadline_ns = chain.now_ns() + round(1e9 * within_s)
    while chain.now_ns() < deadline_ns:
        if (cause := _host_cause(chain)) is not None:
            return cause
        # Latched hosts refuse commands, as intended.
        with suppress(CommandRejected):
            _cycle(chain, leases, beats=beats)
    return _host_cause(chain)


def _host_cause(chain: Chain) -> Cause | None:
    """Return the cause for which the hosts have latched, once all have."""
    causes = [link.latched() for link in chain.hosts]
    return None if None in causes else causes[0]


def _cycle(chain: Chain, leases: Mapping[str, Lease], *, beats: bool) -> None:
    due_ns = chain.now_ns() + round(1e9 * chain.period_s)
    if beats:
        chain.beat()
    for name, lease in leases.items():
        arm = chain.arms[name]
        ttl_s = _TTL_PERIODS * chain.period_s
        arm.send_twist(TwistCommand(_retreat(chain, name), TwistFrame.TCP, chain.now_ns(), ttl_s), lease)
    chain.sleep(max(0.0, (due_ns - chain.now_ns()) * 1e-9))


def _retreat(chain: Chain, name: str) -> Array:
    """Return a slow twist backwards along the tool's axis, or along the first axis that the arm can follow."""
    able = next(each.spec.capabilities.twist_axes for g in chain.groups for each in g.devices if each.name == name)
    axis = 2 if able[2] else able.index(True)
    twist = np.zeros(6)
    twist[axis] = -SPEED_M_S
    return twist


def _position(arm: RemoteArm) -> Array:
    return np.asarray(arm.tcp().value.T_base_tcp[:3, 3])


def _rested_ns(chain: Chain, arm: RemoteArm, deadline_ns: int) -> int | None:
    """Return when the host saw the arm at rest after the stop; None if not by the deadline."""
    while True:
        rested_ns = arm.rested_ns()
        if rested_ns is not None:
            return rested_ns if rested_ns <= deadline_ns else None
        if chain.now_ns() > deadline_ns:
            return None
        chain.sleep(chain.period_s / 4)
