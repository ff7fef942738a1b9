"""A cell in three dimensions, from its plan alone: frames, and what is drawn in each."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from touchcell.cell.config.cell_plan import ArmSection, CellPlan
from touchcell.cell.config.planning_scene import link_capsules
from touchcell.cell.scene.frames import (
    WORLD,
    base_frame,
    link_frame,
    object_frame,
    sensor_frame,
    surface_frame,
    tcp_frame,
)
from touchcell.control.interlocks.boundary import WorkspaceConfig
from touchcell.control.interlocks.collision import BASE, TOOL, Capsule
from touchcell.drivers.core.scene import SceneBody, scene_section
from touchcell.drivers.kinematics.chain import SerialChain
from touchcell.geometry import se3
from touchcell.geometry.solids import Cuboid, Cylinder, Polyline, Solid, Sphere
from touchcell.geometry.types import Array

Colour = tuple[float, float, float, float]

ARM_COLOURS: Final[tuple[Colour, ...]] = (
    (0.30, 0.45, 0.69, 1.0),
    (0.87, 0.52, 0.32, 1.0),
    (0.33, 0.66, 0.41, 1.0),
    (0.51, 0.45, 0.70, 1.0),
)
"""Colours of the arms, in the order of the cell file."""
OBJECT_COLOUR: Final[Colour] = (0.90, 0.77, 0.58, 1.0)
SURFACE_COLOUR: Final[Colour] = (0.75, 0.72, 0.68, 1.0)
TARGET_COLOUR: Final[Colour] = (0.84, 0.15, 0.16, 1.0)
WORKSPACE_COLOUR: Final[Colour] = (0.35, 0.55, 0.85, 0.6)
BODY_COLOUR: Final[Colour] = (0.25, 0.25, 0.28, 1.0)

# A TacTip: a hemispherical tip on a body of about the same width.
_TIP_RADIUS_M: Final = 0.020
_SENSOR_RADIUS_M, _SENSOR_LENGTH_M = 0.0185, 0.045
# An arm of which only the tool's pose is known is drawn as the last part of one.
_QUILL_RADIUS_M, _QUILL_LENGTH_M = 0.014, 0.16
_LINK_RADIUS_M: Final = 0.035
_TARGET_RADIUS_M: Final = 0.006
_MARK: Final = np.array([0.0, 0.0, 0.08])


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame that stays where it is in its parent: ``T_parent_frame`` (4, 4)."""

    name: str
    parent: str
    T_parent_frame: Array


@dataclass(frozen=True, slots=True)
class Part:
    """A solid to draw.

    Attributes:
        name: of the thing that it belongs to; parts of one name belong together.
        frame: that it is fixed in.
        solid: its shape.
        T_frame_solid: (4, 4) its pose in the frame.
        colour: red, green, blue, opacity.
    """

    name: str
    frame: str
    solid: Solid
    T_frame_solid: Array
    colour: Colour


@dataclass(frozen=True, slots=True)
class MovingFrame:
    """A frame whose pose in the world is a known function of time, as that of a surface with a prescribed motion."""

    name: str
    pose: Callable[[float], Array]


@dataclass(frozen=True)
class SceneDescription:
    """A cell in three dimensions.

    Attributes:
        frames: that stand still in their parents.
        parts: solids in these frames, and in those of tools, links and objects.
        moving: frames with a prescribed motion.
        chains: kinematics of the arms whose joints are known, by role.
        target: (3,) where a pushed object is to go, in the world; None for other tasks.
        path: (n, 3) the planned path in the world; None where none is known.
    """

    frames: Sequence[Frame]
    parts: Sequence[Part]
    moving: Sequence[MovingFrame] = ()
    chains: dict[str, SerialChain] = field(default_factory=dict)
    target: Array | None = None
    path: Array | None = None


def describe_scene(plan: CellPlan) -> SceneDescription:
    """Return what a planned cell looks like. Raises ConfigError for a scene that cannot be read."""
    role_of = {name: role for role, name in plan.arm_roles.items()}
    role_of |= {name: name for name in plan.arms if name not in role_of}
    frames: list[Frame] = []
    parts: list[Part] = []
    chains: dict[str, SerialChain] = {}
    for k, (name, role) in enumerate(sorted(role_of.items(), key=lambda each: list(plan.cell.arms).index(each[0]))):
        section = plan.cell.arms[name]
        colour = ARM_COLOURS[k % len(ARM_COLOURS)]
        frames.append(Frame(base_frame(role), WORLD, section.T_world_base))
        chain = plan.arms[name].config.described_chain() if name in plan.arms else None
        if chain is not None:
            chains[role] = chain
        parts += _arm(role, section, chain, colour)
        for sensor_role, sensor_name in plan.sensor_roles.items():
            sensor = plan.cell.sensors[sensor_name]
            if sensor.mounted_on == name:
                frames.append(Frame(sensor_frame(sensor_role), tcp_frame(role), sensor.T_tcp_sensor))
                parts += _sensor(sensor_role, colour)
    for sensor_role, sensor_name in plan.sensor_roles.items():
        if plan.cell.sensors[sensor_name].mounted_on is None:
            frames.append(Frame(sensor_frame(sensor_role), WORLD, np.eye(4)))
            parts += _sensor(sensor_role, ARM_COLOURS[0])
    moving: list[MovingFrame] = []
    bodies = () if plan.cell.scene is None else scene_section().model_validate(plan.cell.scene).bodies()
    for body in bodies:
        if body.moves:
            moving.append(MovingFrame(surface_frame(body.name), body.pose))
        elif not body.free:
            frames.append(Frame(surface_frame(body.name), WORLD, body.pose(0.0)))
        parts += _body(body)
    for name, box in plan.cell.obstacles.items():
        frames.append(Frame(surface_frame(name), WORLD, se3.from_euler_mm_deg(np.array(box.pose_mm_deg))))
        size = (1e-3 * box.size_mm[0], 1e-3 * box.size_mm[1], 1e-3 * box.size_mm[2])
        parts.append(Part(name, surface_frame(name), Cuboid(size), np.eye(4), SURFACE_COLOUR))
    parts += _workspaces(plan, set(role_of.values()))
    target, path = _target(plan, bodies), _path(plan, bodies)
    if target is not None:
        parts.append(Part("target", WORLD, Cylinder(_TARGET_RADIUS_M, 0.001), _shift(target), TARGET_COLOUR))
        parts.append(Part("target", WORLD, Polyline(np.array([target, target + _MARK])), np.eye(4), TARGET_COLOUR))
    if path is not None:
        parts.append(Part("path", WORLD, Polyline(path), np.eye(4), TARGET_COLOUR))
    return SceneDescription(tuple(frames), tuple(parts), tuple(moving), chains, target, path)


def capsule_solids(start: Array, end: Array, radius_m: float) -> Iterator[tuple[Solid, Array]]:
    """Yield a capsule's cylinder and its two ends, each with its pose (4, 4)."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    if length > 1e-6:
        T = np.eye(4)
        T[:3, :3] = _towards(axis / length)
        T[:3, 3] = 0.5 * (start + end)
        yield Cylinder(radius_m, length), T
    for point in (start, end):
        yield Sphere(radius_m), _shift(point)


def _arm(role: str, section: ArmSection, chain: SerialChain | None, colour: Colour) -> Iterator[Part]:
    for part in section.body:
        start = part.from_mm
        if start is not None:
            for solid, T in capsule_solids(1e-3 * np.array(start), 1e-3 * np.array(part.to_mm), 1e-3 * part.radius_mm):
                yield Part(f"{role} body", tcp_frame(role), solid, T, colour)
    if chain is None:
        quill = Cylinder(_QUILL_RADIUS_M, _QUILL_LENGTH_M)
        yield Part(f"{role} arm", tcp_frame(role), quill, _shift([0, 0, -0.5 * _QUILL_LENGTH_M]), colour)
        return
    capsules = link_capsules(chain.description) or list(_thin_links(chain))
    for capsule in capsules:
        number = capsule.frames[0]
        frame = base_frame(role) if number == BASE else tcp_frame(role) if number == TOOL else link_frame(role, number)
        first, last = (np.array(each) for each in capsule.ends_m)
        for solid, T in capsule_solids(first, last, capsule.radius_m):
            yield Part(f"{role} arm", frame, solid, T, colour)


def _thin_links(chain: SerialChain) -> Iterator[Capsule]:
    """Yield capsules from each joint to the next, of a chain that has none of its own."""
    joints = chain.description.joints
    for k, joint in enumerate(joints):
        end = tuple(1e-3 * value for value in joint.origin_mm)
        frame = BASE if k == 0 else k
        yield Capsule(joint.name, (frame, frame), ((0.0, 0.0, 0.0), (end[0], end[1], end[2])), _LINK_RADIUS_M)


def _sensor(role: str, colour: Colour) -> Iterator[Part]:
    body = Cylinder(_SENSOR_RADIUS_M, _SENSOR_LENGTH_M)
    yield Part(role, sensor_frame(role), body, _shift([0, 0, -0.5 * _SENSOR_LENGTH_M]), BODY_COLOUR)
    yield Part(role, sensor_frame(role), Sphere(_TIP_RADIUS_M), np.eye(4), colour)


def _body(body: SceneBody) -> Iterator[Part]:
    frame = object_frame(body.name) if body.free else surface_frame(body.name)
    for solid, T in body.solids:
        yield Part(body.name, frame, solid, T, OBJECT_COLOUR if body.free else SURFACE_COLOUR)


def _workspaces(plan: CellPlan, roles: set[str]) -> Iterator[Part]:
    for name, entry in plan.cell.interlocks.items():
        if isinstance(entry, WorkspaceConfig) and entry.arm in roles:
            yield Part(
                name,
                base_frame(entry.arm),
                Polyline(_edges(1e-3 * np.array(entry.min_mm), 1e-3 * np.array(entry.max_mm))),
                np.eye(4),
                WORKSPACE_COLOUR,
            )


def _edges(low: Array, high: Array) -> Array:
    """Return one line (16, 3) along all twelve edges of a box."""
    order = "000 100 110 010 000 001 101 100 101 111 110 111 011 010 011 001"
    corners = [[high[i] if bit == "1" else low[i] for i, bit in enumerate(word)] for word in order.split()]
    return np.array(corners)


def _target(plan: CellPlan, bodies: Sequence[SceneBody]) -> Array | None:
    place = _settings(plan).get("target_mm")
    if place is None:
        return None
    T_world_base = _pushing_base(plan)
    target = (T_world_base @ np.array([1e-3 * place[0], 1e-3 * place[1], 0.0, 1.0]))[:3]
    target[2] = next((float(body.pose(0.0)[2, 3]) for body in bodies if body.free), float(target[2]))
    return np.asarray(target)


def _path(plan: CellPlan, bodies: Sequence[SceneBody]) -> Array | None:
    settings = _settings(plan)
    target = _target(plan, bodies)
    if target is not None:
        T_world_base = _pushing_base(plan)
        start = next((body.pose(0.0)[:3, 3] for body in bodies if body.free), None)
        way = [(T_world_base @ np.array([1e-3 * x, 1e-3 * y, 0.0, 1.0]))[:3] for x, y in settings.get("path_mm") or ()]
        for point in way:
            point[2] = target[2]
        points = [*([] if start is None else [start]), *way, target]
        return np.array(points) if len(points) > 1 else None
    if "distance_mm" in settings and "direction_deg" in settings and plan.sensor_roles:
        return _followed(plan, settings)
    return None


def _followed(plan: CellPlan, settings: dict[str, Any]) -> Array | None:
    """Return the level line that a sensor travels above a surface, from its start pose."""
    sensor = plan.cell.sensors[next(iter(plan.sensor_roles.values()))]
    arm = plan.cell.arms.get(sensor.mounted_on or "")
    if arm is None or arm.start_pose_mm_deg is None:
        return None
    T = arm.T_world_base @ se3.from_euler_mm_deg(np.array(arm.start_pose_mm_deg)) @ sensor.T_tcp_sensor
    angle = math.radians(settings["direction_deg"])
    way = 1e-3 * settings["distance_mm"] * (T[:3, :3] @ np.array([math.cos(angle), math.sin(angle), 0.0]))
    return np.array([T[:3, 3], T[:3, 3] + way])


def _settings(plan: CellPlan) -> dict[str, Any]:
    return plan.task_config.model_dump()


def _pushing_base(plan: CellPlan) -> Array:
    roles = plan.sensor_roles
    sensor = plan.cell.sensors[roles["leader_sensor"] if "leader_sensor" in roles else next(iter(roles.values()))]
    arm = plan.cell.arms.get(sensor.mounted_on or "")
    return np.eye(4) if arm is None else arm.T_world_base


def _towards(direction: Array) -> Array:
    """Return a rotation (3, 3) that turns z to a unit vector."""
    other = np.array([1.0, 0.0, 0.0]) if abs(direction[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = np.cross(other, direction)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(direction, x), direction])


def _shift(place: Array | Sequence[float]) -> Array:
    T = np.eye(4)
    T[:3, 3] = place
    return T
