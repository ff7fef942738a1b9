"""Scripted contacts in simulated scenes, open loop, to compare fidelities."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.spec import AnyDriver, DriverContext
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.devices import arm as sim_arm
from touchcell.simulation.devices import joint_arm as sim_joint_arm
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.devices.joint_arm import SimJointArm
from touchcell.simulation.scene import Scene, SceneConfig

_CYCLE_S = 0.01
_SI = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
_PANDA = {"left": (-450.0, 0.0, 0.0, 0.0, 0.0, 0.0), "right": (450.0, 0.0, 0.0, 0.0, 0.0, 180.0)}
_STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
_Twist = tuple[float, float, float, float, float, float]


@dataclass(frozen=True, slots=True)
class Script:
    """A scripted motion and its scene.

    Attributes:
        scene: settings of the ``scene:`` section, without its physics.
        start_mm_deg: pose of each tip in the world.
        moves: (seconds, twist of each tip along its own axes in mm/s and deg/s).
        tool: of arms with joints.
    """

    scene: Mapping[str, Any]
    start_mm_deg: Mapping[str, _Twist]
    moves: tuple[tuple[float, Mapping[str, _Twist]], ...]
    tool: str = "right_angle"


@dataclass(slots=True)
class Trace:
    """Result of a script.

    Attributes:
        shear_mm: (n, tips, 2) deflection of the tips.
        force_n: (n, tips).
        objects: T_world_object (4, 4) of each at the end.
        duration_s: simulated time.
        cpu_s: CPU time.
    """

    shear_mm: Array
    force_n: Array
    objects: Mapping[str, Array]
    duration_s: float
    cpu_s: float


def _one(*moves: tuple[float, _Twist]) -> tuple[tuple[float, Mapping[str, _Twist]], ...]:
    return tuple((seconds, {"left": twist}) for seconds, twist in moves)


_BLOCK = {"shape": {"kind": "box", "size_mm": [80, 80, 60]}, "mass_g": 479}
_TALL = {"shape": {"kind": "box", "size_mm": [60, 60, 200]}, "mass_g": 500}
_HOLD: Mapping[str, _Twist] = {"left": (0, 0, 10, 0, 0, 0), "right": (0, 0, 10, 0, 0, 0)}

SCRIPTS: dict[str, Script] = {
    "press, shear, twist, tilt, slip": Script(
        {"surfaces": {"floor": {"kind": "plane", "pose_mm_deg": (0, 0, 200, 0, 0, 0)}}},
        {"left": (0, 0, 220.5, 180, 0, 0)},
        _one(
            (0.45, (0, 0, 10, 0, 0, 0)),
            (0.30, _STILL),
            (0.40, (10, 0, 0, 0, 0, 0)),
            (0.50, _STILL),
            (0.30, (0, 0, 0, 0, 0, 10)),
            (0.50, (0, 0, 0, 20, 0, 0)),
            (0.30, (0, -20, 0, 0, 0, 0)),
            (0.30, _STILL),
        ),
        tool="straight",
    ),
    "push a block": Script(
        {"objects": {"block": _BLOCK}},
        {"left": (-60.5, 0, 30, 0, 90, 0)},
        _one((3.0, (0, 0, 20, 0, 0, 0))),
    ),
    "push it 5 mm off centre": Script(
        {"objects": {"block": _BLOCK}},
        {"left": (-60.5, 5, 30, 0, 90, 0)},
        _one((3.0, (0, 0, 20, 0, 0, 0))),
    ),
    "push a tall one high up": Script(
        {"objects": {"tall": _TALL}, "table": {"friction": 0.5}},
        {"left": (-51, 0, 140, 0, 90, 0)},
        _one((2.0, (0, 0, 30, 0, 0, 0))),
    ),
    "hold and lift with two": Script(
        {"objects": {"block": _BLOCK}},
        {"left": (-60.5, 0, 30, 0, 90, 0), "right": (60.5, 0, 30, 0, -90, 0)},
        (
            (0.65, _HOLD),
            (1.5, {"left": (-20, 0, 0, 0, 0, 0), "right": (20, 0, 0, 0, 0, 0)}),
            (0.5, {}),
        ),
    ),
}


def perform(script: Script, physics: str, physics_step_ms: float = 1.0, *, joints: bool = False) -> Trace:
    """Run ``script``, with jointed arms or with tips that follow their commands exactly."""
    clock = VirtualClock()
    settings = {**script.scene, "physics": physics, "physics_step_ms": physics_step_ms}
    scene = SceneConfig.model_validate(settings).build(clock)
    hands = {tip: _TipArm(tip, script, scene, clock, physics_step_ms, joints=joints) for tip in script.start_mm_deg}
    shears, forces = [], []
    started = time.process_time()
    start_ns = clock.now_ns()
    for seconds, twists in script.moves:
        for _ in range(round(seconds / _CYCLE_S)):
            for tip, hand in hands.items():
                hand.follow(twists.get(tip, _STILL))
            clock.advance_s(_CYCLE_S)
            contacts = [scene.contact(tip).value for tip in hands]
            shears.append([1e3 * state.T_f_s[:2, 3] for state in contacts])
            forces.append([state.normal_force_n for state in contacts])
    cpu_s = time.process_time() - started
    duration_s = (clock.now_ns() - start_ns) * 1e-9
    return Trace(np.array(shears), np.array(forces), dict(scene.objects().value), duration_s, cpu_s)


@dataclass(slots=True)
class _TipArm:
    """One arm with its tip at the tool centre point."""

    tip: str
    script: Script
    scene: Scene
    clock: VirtualClock
    physics_step_ms: float
    joints: bool
    arm: Arm = field(init=False)
    lease: Lease = field(init=False)

    def __post_init__(self) -> None:
        T_world_tip = se3.from_euler_mm_deg(np.array(self.script.start_mm_deg[self.tip], dtype=np.float64))
        base = _PANDA[self.tip] if self.joints else _STILL
        T_base_tip = se3.inverse(se3.from_euler_mm_deg(np.array(base))) @ T_world_tip
        config: dict[str, Any] = {
            "base_pose_mm_deg": base,
            "start_pose_mm_deg": tuple(se3.to_euler_mm_deg(T_base_tip)),
        }
        spec: AnyDriver = sim_arm.SPEC
        if self.joints:
            spec = sim_joint_arm.SPEC
            config |= {"model": "panda", "tool": self.script.tool}
            config |= {"physics_step_ms": self.physics_step_ms}
        arm: Device = spec.build(self.tip, spec.config(**config), DriverContext(self.clock, {}, self.scene))
        assert isinstance(arm, SimArm | SimJointArm)
        self.scene.mount(self.tip, arm.T_world_tcp, arm.apply_force if isinstance(arm, SimJointArm) else None)
        arm.connect()
        arm.configure()
        arm.activate()
        self.arm, self.lease = arm, arm.acquire("script")

    def follow(self, twist_mm_deg: _Twist) -> None:
        twist = np.array(twist_mm_deg) * _SI
        self.arm.send_twist(TwistCommand(twist, TwistFrame.TCP, self.clock.now_ns(), 2.0 * _CYCLE_S), self.lease)
