"""CPU time of safety per cycle, in microseconds: gate, interlocks by number and kind, collisions.

Also the savings of a cell without a sensor, a second arm, or an interlock of a kind.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml

from touchcell.cell.config.armed import REQUIRED_OF_ARMS, REQUIRED_OF_SENSORS
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.planning_scene import link_capsules
from touchcell.control.interlocks.always_on import always_on
from touchcell.control.interlocks.collision import TOOL, Capsule
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.planning_scene import Body, PlanningScene
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.latch import Latch
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.gate import TwistGate, TwistLimits
from touchcell.drivers.core.lease import LeaseManager
from touchcell.drivers.core.samples import JointState, Stamped, TcpState
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, LocalIk, SerialChain
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_REPEATS: Final = 2000
_BATCH: Final = 50
_PERIOD_NS: Final = 10_000_000
_PAIRS: Final = (0, 4, 16, 36, 64)
_CHAIN: Final = SerialChain(ChainDescription.shipped("generic_6r"))
_WORKING: Final = np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
_NEAR_SINGULAR: Final = np.deg2rad([0.0, 40.0, 90.0, 0.0, 5.0, 0.0])
_TWIST: Final = np.array([0.02, 0.0, 0.0, 0.0, 0.0, 0.0])
_PAIR: Final[Mapping[str, Mapping[str, Any]]] = {
    "slip": {"kind": "slip", "limit_ratio": 1.0, "hold_ms": 100},
    "markers_lost": {"kind": "markers_lost", "limit_percent": 10},
    "out_of_step": {"kind": "out_of_step", "limit_mm_s": 30, "limit_mm": 3, "hold_ms": 100},
    "object_lost": {"kind": "object_lost", "limit_ms": 200},
    "toppling": {"kind": "toppling", "limit_deg": 5, "limit_deg_s": 10, "limit_mm": 3, "hold_ms": 100},
}


def costs() -> dict[str, float]:
    """Return microseconds by item, in the order in which they are printed."""
    found = {
        "gate: tool speed, acceleration, jerk": _time_us(_Gate(None)),
        "gate: and six joints": _time_us(_Gate(_WORKING)),
        "gate: and six joints near a singularity": _time_us(_Gate(_NEAR_SINGULAR)),
    }
    shipped = yaml.safe_load(find_cell(Path("configs/object_track_sim.yaml")).read_text())["interlocks"]
    required = [n for n in shipped if shipped[n]["kind"] in REQUIRED_OF_ARMS + REQUIRED_OF_SENSORS]
    to_move = [n for n in required if shipped[n]["kind"] in REQUIRED_OF_ARMS]
    one, two = _views(("arm",)), _views(("leader", "follower"))
    blind = [replace(view, sensors={}) for view in one]
    # Without a sensor the box is for the tool.
    unfelt = {n: {key: value for key, value in shipped[n].items() if key != "sensor"} for n in to_move}
    chosen = {n: shipped[n] for n in required}
    found["review: one arm, no sensor, finite only"] = _review_us({}, blind)
    found[f"review: one arm, no sensor, {len(unfelt)} interlocks"] = _review_us(unfelt, blind)
    bare = found["review: one arm and sensor, finite only"] = _review_us({}, one)
    found[f"review: one arm and sensor, {len(chosen)} interlocks"] = _review_us(chosen, one)
    found[f"review: one arm and sensor, {len(shipped)} interlocks"] = _review_us(shipped, one)
    for name, entry in shipped.items():
        found[f"  of it {entry['kind']}"] = round(max(0.0, _review_us({name: entry}, one) - bare), 2)
    found[f"review: one arm and sensor, {len(shipped)} interlocks and those always on"] = _review_us(
        shipped, one, always=True
    )
    pair = _for_two(shipped)
    bare = found["review: two arms and sensors, finite only"] = _review_us({}, two)
    found[f"review: two arms and sensors, {len(pair)} interlocks"] = _review_us(pair, two)
    pair |= _PAIR
    found[f"review: two arms and sensors, {len(pair)} interlocks"] = _review_us(pair, two)
    for name, entry in _PAIR.items():
        found[f"  of it {name}"] = round(max(0.0, _review_us({name: entry}, two) - bare), 2)
    for pairs in _PAIRS:
        found[f"clearance: {pairs} pairs, all far"] = _clearance_us(pairs, two, bare, slow_mm=30)
    for pairs in _PAIRS[1:]:
        found[f"clearance: {pairs} pairs, one near"] = _clearance_us(pairs, two, bare, slow_mm=1000)
    links, count = _links_us()
    found[f"clearance: two arms of six links, {count} pairs, all far"] = links
    found["skipped without frame_frozen, exposure: one picture"] = _picture_us()
    return found


def _time_us(call: Callable[[int], object]) -> float:
    """Return the time per call: the lower quartile of batches of thread time, so that other load counts less."""
    times = []
    for first in range(0, _REPEATS, _BATCH):
        started = time.thread_time_ns()
        for k in range(first, first + _BATCH):
            call(k)
        times.append((time.thread_time_ns() - started) / _BATCH)
    return round(1e-3 * float(np.percentile(times, 25)), 2)


def _review_us(
    section: Mapping[str, Any],
    views: Sequence[CellView],
    planning_scene: PlanningScene | None = None,
    *,
    always: bool = False,
) -> float:
    poses = {role: np.eye(4) for role in views[0].sensors}
    rules: list[Interlock | TimedInterlock] = [*build_interlocks(parse_interlocks(section), poses, planning_scene)]
    if always:
        rules.extend(always_on(1e9 / _PERIOD_NS, (), moved=True, arms=views[0].arms, sensors=views[0].sensors))
    supervisor = Supervisor(rules, Latch())
    median_us = _time_us(lambda k: supervisor.review(views[k]))
    assert supervisor.latch.first_cause is None, supervisor.latch.first_cause
    return median_us


def _for_two(shipped: Mapping[str, Any]) -> dict[str, Any]:
    """Return the same interlocks for leader and follower: those about one arm twice, the others once."""
    section: dict[str, Any] = {}
    for name, entry in shipped.items():
        if "arm" not in entry:
            section[name] = entry
            continue
        for role in ("leader", "follower"):
            section[f"{name}_{role}"] = {**entry, "arm": role, "sensor": f"{role}_sensor"}
    return section


def _views(roles: Sequence[str]) -> list[CellView]:
    """Return snapshots of moving arms, each with a sensor in contact, without violations."""
    T = se3.from_euler_mm_deg(np.array([0.0, 0.0, 25.0, 180.0, 0.0, 0.0]))
    T_s_f = se3.inverse(se3.from_euler_mm_deg(np.array([1.0, 0.0, 3.0, 0.0, 0.0, 0.0])))
    views = []
    for k in range(_REPEATS):
        now_ns = k * _PERIOD_NS
        command = TwistCommand(_TWIST, TwistFrame.BASE, now_ns, 0.03)
        arm = ArmView(Stamped(TcpState(T, _TWIST), now_ns, k), command, Sent(command, now_ns))
        arms, sensors = {}, {}
        for role in roles:
            arms[role] = arm
            sensors["sensor" if role == "arm" else f"{role}_sensor"] = SensorView(
                now_ns, k, True, 3e-3, True, 6.0, 3e-4, 1e-3, 0.0, k, 70.0, T_s_f, 1.0, role
            )
        views.append(CellView(now_ns, arms, sensors, "run"))
    return views


def _clearance_us(pairs: int, views: Sequence[CellView], bare_us: float, *, slow_mm: float) -> float:
    """Return the time of a review with ``pairs`` pairs of two arms' capsules, half a metre apart, moving sideways."""
    if pairs == 0:
        return 0.0
    number = round(pairs**0.5)
    parts = [
        Capsule(f"part {k}", (TOOL, TOOL), ((0.0, 0.0, -0.05 * k), (0.0, 0.02, -0.05 * k - 0.04)), 0.02)
        for k in range(number)
    ]
    aside = se3.from_euler_mm_deg(np.array([0.0, 500.0, 0.0, 0.0, 0.0, 0.0]))
    bodies = {"leader": Body(np.eye(4), parts), "follower": Body(aside, parts)}
    section = {"clear": {"kind": "clearance", "limit_mm": 20, "slow_mm": slow_mm}}
    return round(_review_us(section, views, PlanningScene({}, bodies)) - bare_us, 2)


def _links_us() -> tuple[float, int]:
    """Return the time of a review of two jointed arms that are apart, and the number of pairs."""
    ik = DifferentialIk(_CHAIN)
    parts = link_capsules(_CHAIN.description)
    away = se3.from_euler_mm_deg(np.array([0.0, 3000.0, 0.0, 0.0, 0.0, 0.0]))
    bodies = {
        role: Body(T, parts, lambda: ik, _CHAIN.joint_count) for role, T in (("leader", np.eye(4)), ("follower", away))
    }
    section = {"clear": {"kind": "clearance", "limit_mm": 20, "slow_mm": 30}}
    (rule,) = build_interlocks(parse_interlocks(section), {}, PlanningScene({}, bodies))
    T = _CHAIN.forward(_WORKING)
    views = []
    for k in range(_REPEATS):
        joints = Stamped(JointState(_WORKING, np.zeros(6)), k * _PERIOD_NS, k)
        command = TwistCommand(_TWIST, TwistFrame.BASE, k * _PERIOD_NS, 0.03)
        arm = ArmView(Stamped(TcpState(T, _TWIST), k * _PERIOD_NS, k), command, joints=joints)
        views.append(CellView(k * _PERIOD_NS, {"leader": arm, "follower": arm}))
    supervisor = Supervisor([], Latch())
    with_rule = _review_us(section, views, PlanningScene({}, bodies))
    bare = _time_us(lambda k: supervisor.review(views[k]))
    return round(with_rule - bare, 2), len(rule.clearances.pairs)  # type: ignore[union-attr]


def _picture_us() -> float:
    """Return the time of checksum and mean of a frame, which only those two interlocks need.

    Per frame, not per cycle.
    """
    image = np.random.default_rng(0).integers(0, 255, (480, 640), dtype=np.uint8)

    def look(k: int) -> float:
        sample = np.ascontiguousarray(image[::3, ::3])
        return zlib.crc32(sample.data) + float(sample.mean())

    return _time_us(look)


class _Gate:
    """A gate that transforms a twist along tool axes, and limits nothing of it."""

    def __init__(self, q: Array | None) -> None:
        self._clock = VirtualClock()
        desk = LeaseManager("arm")
        self._gate = TwistGate("arm", TwistLimits(0.1, 10.0, 1.0, 100.0, 1e4, 1e5), desk, self._clock)
        self._lease = desk.acquire("bench")
        self._T = np.eye(4)
        self._ik = DifferentialIk(_CHAIN)
        self._q = q

    def __call__(self, k: int) -> None:
        self._clock.advance_s(0.01)
        command = TwistCommand(_TWIST, TwistFrame.TCP, self._clock.now_ns(), 0.03)
        self._gate.admit(command, self._lease, Lifecycle.ACTIVE, self._T, joints=self._joints)

    def _joints(self) -> LocalIk | None:
        return None if self._q is None else self._ik.at(self._q)
