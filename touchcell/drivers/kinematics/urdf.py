"""Chains from URDF files: the serial arm in a robot's description, with its limits, masses and collision shapes.

Source: the URDF specification (wiki.ros.org/urdf/XML). Angles ``rpy`` are extrinsic xyz, as in ``Placement``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

from touchcell.errors import ConfigError, suggest
from touchcell.geometry.types import Array

SUFFIX: Final = ".urdf"
_TURNING: Final = ("revolute", "continuous")
_MOVING: Final = (*_TURNING, "prismatic", "planar", "floating")
_FLANGES: Final = ("tool0", "flange", "ee_link", "tcp")
_ENDLESS_DEG: Final = 36_000.0
_SEVERAL_ARMS: Final = 3
_ROUND_MM: Final = 1e-3
_PACKAGE: Final = "package://"


class UrdfName(NamedTuple):
    """A file, and first and last link of the arm in it; None where they follow from the file."""

    file: Path
    base: str | None
    tip: str | None


@dataclass(slots=True)
class _Joint:
    """A joint of the file: its type, links, placement (4, 4), axis, and element."""

    name: str
    kind: str
    parent: str
    child: str
    T: Array
    axis: Array
    element: Element
    mimics: bool


@dataclass(slots=True)
class _Robot:
    """The joints of a file by the link from which they go, and its links."""

    name: str
    file: Path
    links: dict[str, Element] = field(default_factory=dict)
    joints: dict[str, list[_Joint]] = field(default_factory=dict)

    def problem(self, reason: str, key: str = "", hint: str = "") -> ConfigError:
        """Return an error about the file."""
        return ConfigError(reason, file=str(self.file), key=key, hint=hint)


def parse_name(name: str) -> UrdfName:
    """Split ``file.urdf``, ``file.urdf#TIP`` or ``file.urdf#BASE:TIP``."""
    file, _, links = name.partition("#")
    base, colon, tip = links.rpartition(":")
    return UrdfName(Path(file), base if colon and base else None, tip or None)


def read_chain(name: UrdfName) -> dict[str, Any]:
    """Return the fields of the ``ChainDescription`` of an arm.

    Without a last link the arm is the path of most turning joints, up to where it branches into fingers; its flange is
    a link ``tool0``, ``flange``, ``ee_link`` or ``tcp`` on the last joint's link if there is one, else that link.

    Raises:
        ConfigError: no URDF, an arm that cannot be told from others, or a joint without what a chain needs.
    """
    robot = _read(name.file)
    base = name.base or _root(robot)
    for link in (base, name.tip):
        if link is not None and link not in robot.links:
            hint = suggest(link, sorted(robot.links), otherwise="links")
            raise robot.problem(f"has no link {link!r}", key="chain", hint=hint)
    path = _path_to(robot, base, name.tip) if name.tip is not None else _longest(robot, base)
    arm = [joint for joint in path if joint.kind in _MOVING]
    for joint in arm:
        if joint.kind not in _TURNING or joint.mimics:
            kind = "follows another joint" if joint.mimics else f"is {joint.kind}"
            raise robot.problem(
                f"joint {joint.name!r} {kind}, and a chain turns",
                hint=f"begin or end beside it: {name.file.name}#BASE:TIP",
            )
    if not arm:
        raise robot.problem(f"no joint turns between {base!r} and {name.tip or 'any other link'!r}")
    return _description(robot, base, path, arm)


def _description(robot: _Robot, base: str, path: list[_Joint], arm: list[_Joint]) -> dict[str, Any]:
    on_arm = {joint.name for joint in arm}
    T, joints = np.eye(4), []
    for joint in path:
        T = T @ joint.T
        if joint.name in on_arm:
            joints.append(_joint(robot, joint, T, on_arm))
            T = np.eye(4)
    capsules = [_capsule_fields(*found) for found in _shapes(robot, base, on_arm)]
    return {"name": robot.name, "base_capsules": capsules, "joints": joints, "flange": _placement(T)}


def _joint(robot: _Robot, joint: _Joint, T: Array, on_arm: set[str]) -> dict[str, Any]:
    limit = joint.element.find("limit")
    limits = {} if limit is None else limit.attrib
    endless = joint.kind == "continuous"
    if not endless and not {"lower", "upper"} <= limits.keys():
        raise robot.problem(f"joint {joint.name!r} has no range", hint="<limit lower= upper= velocity= effort=/>")
    ends = (_number(robot, limits.get(name, "0"), f"{name} end of {joint.name}") for name in ("lower", "upper"))
    lower, upper = (-_ENDLESS_DEG, _ENDLESS_DEG) if endless else map(math.degrees, ends)
    speed, torque = (_number(robot, limits.get(name, "0"), name) for name in ("velocity", "effort"))
    if not (speed > 0.0 and torque > 0.0):
        missing = "velocity" if not speed > 0.0 else "effort"
        raise robot.problem(
            f"joint {joint.name!r} has no {missing} limit", hint="write the one of the datasheet: rad/s, N m"
        )
    mass, com = _mass(robot, joint.child, on_arm)
    return {
        **_placement(T),
        "name": joint.name,
        "axis": tuple(joint.axis.tolist()),
        "lower_deg": lower,
        "upper_deg": upper,
        "speed_deg_s": math.degrees(speed),
        "torque_n_m": torque,
        "mass_kg": mass,
        "com_mm": tuple((1e3 * com).tolist()),
        "capsules": [_capsule_fields(*found) for found in _shapes(robot, joint.child, on_arm)],
    }


def _read(file: Path) -> _Robot:
    try:
        root = ElementTree.parse(file).getroot()
    except (OSError, ElementTree.ParseError) as error:
        raise ConfigError(f"is no URDF file: {error}", file=str(file)) from None
    if root.tag != "robot":
        raise ConfigError(f"is no URDF file: its root is <{root.tag}>", file=str(file))
    if any(element.tag.startswith("{http://www.ros.org/wiki/xacro}") for element in root.iter()):
        raise ConfigError(
            "is a xacro file", file=str(file), hint="`xacro arm.urdf.xacro > arm.urdf` makes a URDF of it"
        )
    robot = _Robot(root.get("name", file.stem), file)
    robot.links = {link.get("name", ""): link for link in root.findall("link")}
    children: set[str] = set()
    for element in root.findall("joint"):
        joint = _read_joint(robot, element)
        if joint.parent not in robot.links or joint.child not in robot.links:
            raise robot.problem(f"joint {joint.name!r} joins links that are not there")
        if joint.child in children:
            raise robot.problem(f"link {joint.child!r} has two parents")
        children.add(joint.child)
        robot.joints.setdefault(joint.parent, []).append(joint)
    return robot


def _read_joint(robot: _Robot, element: Element) -> _Joint:
    parent, child = element.find("parent"), element.find("child")
    axis_element = element.find("axis")
    axis = np.array([1.0, 0.0, 0.0]) if axis_element is None else _vector(robot, axis_element.get("xyz", "1 0 0"))
    name, kind = element.get("name", ""), element.get("type", "")
    if parent is None or child is None or (kind in _TURNING and not np.linalg.norm(axis) > 0.0):
        raise robot.problem(f"joint {name!r} lacks a parent, a child or an axis")
    return _Joint(
        name,
        kind,
        parent.get("link", ""),
        child.get("link", ""),
        _pose(robot, element.find("origin")),
        axis,
        element,
        element.find("mimic") is not None,
    )


def _root(robot: _Robot) -> str:
    children = {joint.child for joints in robot.joints.values() for joint in joints}
    roots = [link for link in robot.links if link not in children]
    if len(roots) != 1:
        raise robot.problem(f"has {len(roots)} links without a parent, and a robot has one")
    return roots[0]


def _path_to(robot: _Robot, base: str, tip: str) -> list[_Joint]:
    to_child = {joint.child: joint for joints in robot.joints.values() for joint in joints}
    path: list[_Joint] = []
    link = tip
    while link != base:
        joint = to_child.get(link)
        if joint is None or joint in path:
            raise robot.problem(f"no path leads from {base!r} to {tip!r}")
        path.append(joint)
        link = joint.parent
    return path[::-1]


def _count(robot: _Robot, joint: _Joint) -> int:
    """Return how many joints turn on the longest path from here, this one included; followers do not count."""
    below = [_count(robot, each) for each in robot.joints.get(joint.child, [])]
    return (joint.kind in _TURNING and not joint.mimics) + max(below, default=0)


def _longest(robot: _Robot, base: str) -> list[_Joint]:
    path: list[_Joint] = []
    link = base
    while True:
        counted = sorted(((_count(robot, each), i) for i, each in enumerate(robot.joints.get(link, []))), reverse=True)
        if not counted or counted[0][0] == 0:
            break
        if len(counted) > 1 and counted[1][0] == counted[0][0]:
            if counted[0][0] >= _SEVERAL_ARMS:
                names = ", ".join(robot.joints[link][i].child for count, i in counted if count == counted[0][0])
                raise robot.problem(
                    f"has several arms after {link!r}: {names}",
                    key="chain",
                    hint=f"name the last link of yours: {robot.file.name}#TIP, or #BASE:TIP",
                )
            break
        joint = robot.joints[link][counted[0][1]]
        path.append(joint)
        link = joint.child
    last = max((i for i, joint in enumerate(path) if joint.kind in _TURNING), default=-1)
    del path[last + 1 :]
    return path + _to_flange(robot, path[-1].child if path else base)


def _to_flange(robot: _Robot, link: str) -> list[_Joint]:
    """Return the fixed joints from the last turning joint's link to the flange; none where no link is named as one."""
    reached: list[list[_Joint]] = [[]]
    for path in reached:
        end = path[-1].child if path else link
        reached += [[*path, joint] for joint in robot.joints.get(end, []) if joint.kind == "fixed"]
    named = [path for path in reached if path and path[-1].child in _FLANGES]
    return min(named, key=lambda path: _FLANGES.index(path[-1].child), default=[])


def _carried(robot: _Robot, link: str, on_arm: set[str], T: Array | None = None) -> Iterator[tuple[str, Array]]:
    """Yield the links that move with ``link``, and their poses in it: all beyond it but the arm's next ones."""
    T = np.eye(4) if T is None else T
    yield link, T
    for joint in robot.joints.get(link, []):
        if joint.name not in on_arm:
            yield from _carried(robot, joint.child, on_arm, T @ joint.T)


def _mass(robot: _Robot, link: str, on_arm: set[str]) -> tuple[float, Array]:
    total, moment = 0.0, np.zeros(3)
    for name, T in _carried(robot, link, on_arm):
        inertial = robot.links[name].find("inertial")
        mass_element = None if inertial is None else inertial.find("mass")
        if inertial is None or mass_element is None:
            continue
        mass = _number(robot, mass_element.get("value", "0"), f"mass of {name}")
        centre = (T @ _pose(robot, inertial.find("origin")))[:3, 3]
        total, moment = total + mass, moment + mass * centre
    return total, moment / total if total > 0.0 else np.zeros(3)


def _shapes(robot: _Robot, link: str, on_arm: set[str]) -> Iterator[tuple[Array, Array, float]]:
    """Yield capsules around the collision shapes of a link and what it carries: two points (3,) and a radius, m."""
    for name, T in _carried(robot, link, on_arm):
        for collision in robot.links[name].findall("collision"):
            geometry = collision.find("geometry")
            shape = None if geometry is None or not len(geometry) else geometry[0]
            found = None if shape is None else _capsule(robot, shape)
            if found is not None:
                T_shape = T @ _pose(robot, collision.find("origin"))
                start, end = (T_shape[:3, :3] @ point + T_shape[:3, 3] for point in found[:2])
                yield start, end, found[2]


def _capsule(robot: _Robot, shape: Element) -> tuple[Array, Array, float] | None:
    """Return a capsule that contains a shape; None for a mesh that cannot be read here."""
    if shape.tag == "sphere":
        return np.zeros(3), np.zeros(3), _number(robot, shape.get("radius", "0"), "radius")
    if shape.tag == "cylinder":
        half = 0.5 * _number(robot, shape.get("length", "0"), "length")
        return (
            np.array([0.0, 0.0, -half]),
            np.array([0.0, 0.0, half]),
            _number(robot, shape.get("radius", "0"), "radius"),
        )
    if shape.tag == "box":
        half_size = 0.5 * _vector(robot, shape.get("size", "0 0 0"))
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half_size
        return around(corners)
    return _mesh_capsule(robot, shape) if shape.tag == "mesh" else None


def _mesh_capsule(robot: _Robot, shape: Element) -> tuple[Array, Array, float] | None:
    file = _mesh_file(robot.file, shape.get("filename", ""))
    if file is None:
        return None
    try:
        import trimesh

        points = np.asarray(trimesh.load(file, force="mesh").vertices, dtype=np.float64)
    except (ImportError, ValueError, OSError, NotImplementedError):
        return None
    scale = _vector(robot, shape.get("scale", "1 1 1"))
    return around(points * scale) if len(points) else None


def _mesh_file(urdf: Path, name: str) -> Path | None:
    """Return the file of a mesh: relative to the URDF, or of a package in whose folder the URDF lies."""
    if not name.startswith(_PACKAGE):
        file = urdf.parent / name.removeprefix("file://")
        return file if file.is_file() else None
    inside = Path(name.removeprefix(_PACKAGE))
    for folder in urdf.absolute().parents:
        for file in (folder / inside, folder / Path(*inside.parts[1:])):
            if file.is_file():
                return file
    return None


def around(points: Array) -> tuple[Array, Array, float]:
    """Return a capsule that contains points (n, 3) m: along their principal axis, as thick as they are far from it."""
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    off = points - centre
    axis = np.linalg.svd(off, full_matrices=False)[2][0]
    along = off @ axis
    away = np.linalg.norm(off - along[:, None] * axis, axis=1)
    radius = float(away.max())
    # Each end may come in as far as its cap still covers the points beyond it.
    cap = np.sqrt(np.maximum(radius**2 - away**2, 0.0))
    low, high = float((along + cap).min()), float((along - cap).max())
    if low > high:
        low = high = 0.5 * (low + high)
        radius = float(np.hypot(along - low, away).max())
    return centre + low * axis, centre + high * axis, radius


def _capsule_fields(start: Array, end: Array, radius: float) -> dict[str, Any]:
    return {
        "from_mm": tuple((1e3 * start).tolist()),
        "to_mm": tuple((1e3 * end).tolist()),
        "radius_mm": max(1e3 * radius, _ROUND_MM),
    }


def _placement(T: Array) -> dict[str, Any]:
    return {"origin_mm": tuple((1e3 * T[:3, 3]).tolist()), "rotation_deg": tuple(np.rad2deg(_rpy(T[:3, :3])).tolist())}


def _rpy(R: Array) -> Array:
    """Return extrinsic xyz angles (3,) rad of a rotation matrix."""
    sine = math.hypot(R[0, 0], R[1, 0])
    if sine > 1e-9:
        return np.array([math.atan2(R[2, 1], R[2, 2]), math.atan2(-R[2, 0], sine), math.atan2(R[1, 0], R[0, 0])])
    # Looking straight along z, only the sum or difference of the other two is defined.
    return np.array([math.atan2(-R[1, 2], R[1, 1]), math.atan2(-R[2, 0], sine), 0.0])


def _pose(robot: _Robot, origin: Element | None) -> Array:
    T = np.eye(4)
    if origin is not None:
        roll, pitch, yaw = _vector(robot, origin.get("rpy", "0 0 0")).tolist()
        cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
        T[:3, :3] = [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
        T[:3, 3] = _vector(robot, origin.get("xyz", "0 0 0"))
    return T


def _vector(robot: _Robot, text: str) -> Array:
    values = _numbers(robot, text.split(), "vector")
    if len(values) != 3:
        raise robot.problem(f"{text!r} is not three numbers")
    return np.array(values)


def _number(robot: _Robot, text: str, name: str) -> float:
    return _numbers(robot, [text], name)[0]


def _numbers(robot: _Robot, texts: Sequence[str], name: str) -> list[float]:
    try:
        values = [float(text) for text in texts]
    except ValueError:
        raise robot.problem(f"{' '.join(texts)!r} is no {name}") from None
    if not all(map(math.isfinite, values)):
        raise robot.problem(f"{' '.join(texts)!r} is not finite")
    return values
