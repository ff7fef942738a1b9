"""Checks of the dynamic scene against theory or against itself at 0.1 ms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.scene import ContactState
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.scene import SceneConfig

GRAVITY_M_S2 = 9.81
_SI = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
_STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_ABOVE = (0.0, 0.0, 20.5, 180.0, 0.0, 0.0)
_FLOOR = {"surfaces": {"floor": {"kind": "plane"}}}
_Twist = tuple[float, ...]


class CommandedTip:
    """One tip that follows its command exactly, through its own scene.

    Args:
        scene: settings of the ``scene:`` section, without its physics.
        start_mm_deg: pose of the tip.
        physics: of the scene.
    """

    def __init__(self, scene: Mapping[str, Any], start_mm_deg: _Twist, physics: str = "dynamic") -> None:
        self.clock = VirtualClock()
        self.scene = SceneConfig.model_validate({"physics": physics, **scene}).build(self.clock)
        self.poses = {"tip": se3.from_euler_mm_deg(np.array(start_mm_deg, dtype=np.float64))}
        self.scene.mount("tip", lambda: self.poses["tip"])

    def move(self, twist_mm_deg: _Twist, seconds: float) -> ContactState:
        """Move by a twist along the tip's own axes, mm/s and deg/s; return the contact at the end."""
        return self.move_all({"tip": twist_mm_deg}, seconds)

    def move_all(self, twists_mm_deg: Mapping[str, _Twist], seconds: float) -> ContactState:
        """Move with other tips, which ``poses`` holds and the caller has mounted."""
        step_s = self.scene.timeline.step_ns * 1e-9
        motions = {tip: se3.exp(np.array(twist) * _SI * step_s) for tip, twist in twists_mm_deg.items()}
        for _ in range(round(seconds / step_s)):
            for tip, motion in motions.items():
                self.poses[tip] = self.poses[tip] @ motion
            self.clock.advance_s(step_s)
            self.scene.timeline.advance()
        return self.scene.contact("tip").value

    def object(self) -> Array:
        """T_world_object (4, 4) of the first object."""
        return next(iter(self.scene.objects().value.values()))


@dataclass(frozen=True, slots=True)
class Check:
    """One number, its expected value, and the result.

    Attributes:
        what: description.
        value, aim: as they are printed.
        passed: True if the value meets the aim.
    """

    what: str
    value: str
    aim: str
    passed: bool


def checks() -> list[Check]:
    """Return all checks; takes about five seconds of a core."""
    return [_deflection(), _creep(), *_push_force(), *_yaw(), *_toppling()]


def _deflection() -> Check:
    script = [((0, 0, 10, 0, 0, 0), 0.45), (_STILL, 0.1), ((10, 0, 0, 0, 0, 0), 0.4), ((0, 0, 0, 0, 0, 10), 0.3)]
    script += [((0, 0, 0, 20, 0, 0), 0.4), ((0, -20, 0, 0, 0, 0), 0.4), (_STILL, 0.2)]
    deflections = []
    for step_ms in (1.0, 0.1):
        tip = CommandedTip({**_FLOOR, "physics_step_ms": step_ms}, _ABOVE)
        deflections.append([tip.move(twist, 0.02).T_f_s[:2, 3] for twist, s in script for _ in range(round(s / 0.02))])
    worst_mm = 1e3 * float(np.abs(np.array(deflections[0]) - np.array(deflections[1])).max())
    return Check("tip deflection at 1 ms against 0.1 ms", f"{worst_mm:.3f} mm", "<= 0.1 mm", worst_mm <= 0.1)


def _creep() -> Check:
    tip = CommandedTip(_FLOOR, _ABOVE)
    tip.move((0, 0, 10, 0, 0, 0), 0.45)
    tip.move((10, 0, 0, 0, 0, 0), 0.4)
    before, after = tip.move(_STILL, 0.3), tip.move(_STILL, 2.0)
    creep_um_s = 1e6 * float(np.abs(after.T_f_s[:2, 3] - before.T_f_s[:2, 3]).max()) / 2.0
    return Check("creep of a 4 mm shear that sticks", f"{creep_um_s:.1f} um/s", "<= 10 um/s", creep_um_s <= 10.0)


def _push_force() -> list[Check]:
    found = []
    for friction, name in ((0.3, "MDF"), (0.6, "foam")):
        block = {"shape": {"kind": "box", "size_mm": [80, 80, 60]}, "mass_g": 479}
        tip = CommandedTip({"objects": {"block": block}, "table": {"friction": friction}}, (-60.5, 0, 30, 0, 90, 0))
        tip.move((0, 0, 20, 0, 0, 0), 1.0)
        forces = [tip.move((0, 0, 20, 0, 0, 0), 0.02).normal_force_n for _ in range(100)]
        error = float(np.mean(forces)) / (friction * 0.479 * GRAVITY_M_S2) - 1.0
        found.append(
            Check(f"push force against mu m g, {name}", f"{100 * error:+.1f} %", "within 3 %", abs(error) <= 0.03)
        )
    return found


def _yaw() -> list[Check]:
    found = []
    for size_mm in ((80, 80), (80, 140)):
        # A small tip that does not slip is a point contact, 10 mm beside the centre; it yields by 0.7 mm.
        block = {"shape": {"kind": "box", "size_mm": [*size_mm, 60]}, "mass_g": 400}
        skin = {"radius_mm": 2, "friction": 1.5}
        tip = CommandedTip({"objects": {"block": block}, "tip": skin}, (-42.2, 10, 30, 0, 90, 0))
        tip.move((0, 0, 20, 0, 0, 0), 3.045)
        T = tip.object()
        expected = uniform_pressure_yaw(1e-3 * np.array(size_mm), np.array([-0.042, 0.010]), 0.060)
        error = float(np.arctan2(T[1, 0], T[0, 0])) / expected - 1.0
        what = f"yaw of an off-centre push, {size_mm[0]} x {size_mm[1]} mm, against uniform pressure"
        found.append(Check(what, f"{100 * error:+.1f} %", "within 20 %", abs(error) <= 0.2))
    return found


YAW_SIZES_MM = ((60, 60), (80, 80), (50, 120), (120, 50))
"""Across: of the side that is pushed, in y."""
YAW_ASIDE_MM = (5, 10)


def quasi_static_yaw() -> list[Check]:
    """Return how blocks that are pushed off centre turn in quasi-static physics, against MuJoCo at 0.1 ms.

    Takes half a minute of a core.
    """
    found = []
    for size_mm in YAW_SIZES_MM:
        for aside_mm in YAW_ASIDE_MM:
            fast, fine = (
                _pushed_yaw_deg(size_mm, aside_mm, physics, {"physics_step_ms": step_ms})
                for physics, step_ms in (("quasi_static", 1.0), ("dynamic", 0.1))
            )
            error = fast / fine - 1.0
            what = f"yaw of {size_mm[0]} x {size_mm[1]} mm pushed {aside_mm} mm off centre, quasi-static"
            value = f"{fast:.2f} of {fine:.2f} deg, {100 * error:+.1f} %"
            found.append(Check(what, value, "within 5 %", abs(error) <= 0.05))
    return found


def _pushed_yaw_deg(size_mm: tuple[int, int], aside_mm: int, physics: str, keys: Mapping[str, Any]) -> float:
    block = {"shape": {"kind": "box", "size_mm": [*size_mm, 60]}, "mass_g": 479}
    scene = {"objects": {"block": block}, "table": {"friction": 0.3}, **keys}
    tip = CommandedTip(scene, (-0.5 * size_mm[0] - 20.2, aside_mm, 30, 0, 90, 0), physics)
    tip.move((0, 0, 20, 0, 0, 0), 3.0)
    T = tip.object()
    return float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))


def _toppling() -> list[Check]:
    found = []
    for z_mm, falls in ((140, True), (50, False)):
        tall = {"shape": {"kind": "box", "size_mm": [60, 60, 200]}, "mass_g": 500}
        tip = CommandedTip({"objects": {"tall": tall}, "table": {"friction": 0.5}}, (-51, 0, z_mm, 0, 90, 0))
        tip.move((0, 0, 30, 0, 0, 0), 2.0)
        lean_deg = float(np.degrees(np.arccos(min(tip.object()[2, 2], 1.0))))
        passed = lean_deg > 60.0 if falls else lean_deg < 1.0
        aim = "falls" if falls else "stands"
        found.append(Check(f"lean of a tall prism pushed at {z_mm} mm", f"{lean_deg:.1f} deg", aim, passed))
    return found


def uniform_pressure_yaw(size_m: Array, point: Array, distance_m: float) -> float:
    """Return the rotation (rad) of a block (2,) m with uniform pressure, pushed along x by a point that sticks to it.

    Of all motions that move ``point`` (2,) m, friction selects the one about which it has no moment there.
    """
    cells = (np.arange(24) + 0.5) / 24 - 0.5
    bottom = np.stack(np.meshgrid(cells, cells), axis=-1).reshape(-1, 2) * size_m - point
    across = np.column_stack([-bottom[:, 1], bottom[:, 0]])
    yaw, steps = 0.0, 60
    for _ in range(steps):
        push = np.array([np.cos(yaw), -np.sin(yaw)])
        low, high = -40.0, 40.0
        while high - low > 1e-6:
            rate = 0.5 * (low + high)
            velocity = push + rate * across
            moment = float(np.sum(across * velocity / np.linalg.norm(velocity, axis=1)[:, None]))
            low, high = (low, rate) if moment > 0.0 else (rate, high)
        yaw += low * distance_m / steps
    return yaw
