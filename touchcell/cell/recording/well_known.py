"""Messages that viewers draw by themselves: Foxglove's protobuf schemas, which Foxglove, Lichtblick and Rerun know.

A schema of that package may have more fields than its own, which viewers skip.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from google.protobuf import descriptor_pb2
from google.protobuf.message import Message

from touchcell.cell.recording.message_types import message_class
from touchcell.geometry.solids import Cuboid, Cylinder, Polyline, Solid, Sphere, triangulated
from touchcell.geometry.types import Array

COVARIANCE_FIELD: Final = "covariance"
"""Field of ``foxglove.PoseInFrame`` that is ours: (36,) of x, y, z, rx, ry, rz along the frame's axes, m and rad."""
_COVARIANCE_NUMBER: Final = 100
_LINE_M: Final = 0.0015
_SINGLES: Final = struct.Struct("<7f")


@dataclass(frozen=True)
class WellKnown:
    """A type of the package ``foxglove``.

    Attributes:
        name: without the package.
        covariance: whether it gets a field for a covariance too.
    """

    name: str
    covariance: bool = False

    @property
    def full_name(self) -> str:
        """Name with the package."""
        return f"foxglove.{self.name}"

    @cached_property
    def schema(self) -> bytes:
        """Serialized FileDescriptorSet."""
        from foxglove import messages

        schema: bytes = getattr(messages, self.name).get_schema().data
        return _with_covariance(schema, self.name) if self.covariance else schema

    @cached_property
    def new(self) -> type[Message]:
        """Class of its messages."""
        return message_class(self.full_name, self.schema)


FRAME_TRANSFORM: Final = WellKnown("FrameTransform")
SCENE_UPDATE: Final = WellKnown("SceneUpdate")
POSE_IN_FRAME: Final = WellKnown("PoseInFrame", covariance=True)
COMPRESSED_IMAGE: Final = WellKnown("CompressedImage")
COMPRESSED_VIDEO: Final = WellKnown("CompressedVideo")
JOINT_STATES: Final = WellKnown("JointStates")
LOG: Final = WellKnown("Log")


Pose = tuple[float, ...]
"""Pose as viewers take it: x, y, z in m and the quaternion x, y, z, w, all of single precision, which compresses."""


def drawn_pose(T: Array) -> Pose:
    """Return a pose (4, 4) for viewers."""
    return _SINGLES.unpack(_SINGLES.pack(*T[:3, 3].tolist(), *quaternion(T[:3, :3])))


class TransformMessage:
    """Encodes the poses of one frame in its parent, again and again."""

    def __init__(self, parent: str, frame: str) -> None:
        message: Any = FRAME_TRANSFORM.new(parent_frame_id=parent, child_frame_id=frame)
        self._template = _PoseTemplate(message, message.translation, message.rotation)

    def encode(self, t_wall_ns: int, pose: Pose) -> bytes:
        """Return the pose as bytes."""
        return self._template.encode(t_wall_ns, pose)


class BeliefMessage:
    """Encodes Gaussians over the pose of something in one frame."""

    def __init__(self, frame: str) -> None:
        message: Any = POSE_IN_FRAME.new(frame_id=frame)
        self._template = _PoseTemplate(message, message.pose.position, message.pose.orientation)
        # Serialized with 36 numbers once, for the field's tag and length.
        message = POSE_IN_FRAME.new(**{COVARIANCE_FIELD: [1.0] * 36})
        self._covariance: bytes = message.SerializeToString()[: -36 * 8]

    def encode(self, t_wall_ns: int, pose: Pose, covariance: Array) -> bytes:
        """Return a pose with its covariance (6, 6) along the axes of the frame, m and rad, as bytes."""
        numbers = covariance.astype(np.float32).astype("<f8").tobytes()
        return self._template.encode(t_wall_ns, pose) + self._covariance + numbers


class _PoseTemplate:
    """A message with a stamp and one pose, serialized once: only both are put in.

    Args:
        message: with all else that it has.
        position, orientation: of its pose.
    """

    def __init__(self, message: Any, position: Any, orientation: Any) -> None:
        # Numbers that are nowhere else in the message, to find their places.
        marks = [1.0e-300 * k for k in range(1, 8)]
        position.x, position.y, position.z = marks[:3]
        orientation.x, orientation.y, orientation.z, orientation.w = marks[3:]
        rest = message.SerializeToString()
        items: list[Any] = []
        for mark in marks:
            before, _, rest = rest.partition(struct.pack("<d", mark))
            items += (before, 0.0)
        items.append(rest)
        self._items = items
        self._pack = struct.Struct("<" + "".join(f"{len(text)}sd" for text in items[:-1:2]) + f"{len(rest)}s").pack
        self._stamp = message.timestamp
        number = message.DESCRIPTOR.fields_by_name["timestamp"].number
        self._stamp_tag = bytes((number << 3 | 2,))

    def encode(self, t_wall_ns: int, pose: Pose) -> bytes:
        items = self._items.copy()
        items[1::2] = pose
        _put_stamp(self._stamp, t_wall_ns)
        stamp = self._stamp.SerializeToString()
        return b"".join((self._pack(*items), self._stamp_tag, bytes((len(stamp),)), stamp))


class JointMessage:
    """Encodes the states of an arm's joints."""

    def __init__(self, names: Sequence[str]) -> None:
        self._message: Any = JOINT_STATES.new()
        self._joints = [self._message.joints.add(name=name) for name in names]

    def encode(self, t_wall_ns: int, q: Array, dq: Array, tau: Array | None) -> bytes:
        """Return positions (n,) rad, velocities (n,) rad/s and torques (n,) N m as bytes."""
        _put_stamp(self._message.timestamp, t_wall_ns)
        for joint, position, velocity in zip(self._joints, q.tolist(), dq.tolist(), strict=False):
            joint.position, joint.velocity = position, velocity
        if tau is not None:
            for joint, effort in zip(self._joints, tau.tolist(), strict=False):
                joint.effort = effort
        return self._message.SerializeToString()  # type: ignore[no-any-return]


def log_message(t_wall_ns: int, level: str, name: str, text: str) -> bytes:
    """Return a log line as bytes; ``level`` is INFO, WARNING, ERROR or FATAL."""
    message: Any = LOG.new(level=level, name=name, message=text)
    _put_stamp(message.timestamp, t_wall_ns)
    return message.SerializeToString()  # type: ignore[no-any-return]


def image_message(type_: WellKnown, t_wall_ns: int, frame: str, format_: str, data: bytes) -> bytes:
    """Return a compressed image, or one packet of a video, as bytes."""
    message: Any = type_.new(frame_id=frame, format=format_, data=data)
    _put_stamp(message.timestamp, t_wall_ns)
    return message.SerializeToString()  # type: ignore[no-any-return]


Drawn = tuple[Solid, Array, tuple[float, float, float, float]]
"""A solid, its pose (4, 4) in its entity's frame, and its colour: red, green, blue, opacity."""


def scene_message(t_wall_ns: int, entities: Sequence[tuple[str, str, Sequence[Drawn]]]) -> bytes:
    """Return a scene as bytes.

    Args:
        t_wall_ns: stamp of all entities.
        entities: name, frame and solids of each.
    """
    update: Any = SCENE_UPDATE.new()
    for name, frame, solids in entities:
        entity = update.entities.add(id=name, frame_id=frame, frame_locked=True)
        _put_stamp(entity.timestamp, t_wall_ns)
        for solid, T_frame_solid, colour in solids:
            _add_solid(entity, solid, T_frame_solid, colour)
    return update.SerializeToString()  # type: ignore[no-any-return]


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return x, y, z, w of a rotation matrix (3, 3).

    By the largest of the four, which divides by no small number (Shepperd 1978).
    """
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    trace = a + e + i
    if trace > max(a, e, i):
        s = 2.0 * (1.0 + trace) ** 0.5
        return (h - f) / s, (c - g) / s, (d - b) / s, 0.25 * s
    if a >= max(e, i):
        s = 2.0 * (1.0 + a - e - i) ** 0.5
        return 0.25 * s, (b + d) / s, (c + g) / s, (h - f) / s
    if e >= i:
        s = 2.0 * (1.0 + e - a - i) ** 0.5
        return (b + d) / s, 0.25 * s, (f + h) / s, (c - g) / s
    s = 2.0 * (1.0 + i - a - e) ** 0.5
    return (c + g) / s, (f + h) / s, 0.25 * s, (d - b) / s


def _add_solid(entity: Any, solid: Solid, T: Array, colour: Sequence[float]) -> None:
    if isinstance(solid, Cuboid):
        part = entity.cubes.add()
        part.size.x, part.size.y, part.size.z = solid.size_m
    elif isinstance(solid, Sphere):
        part = entity.spheres.add()
        part.size.x = part.size.y = part.size.z = 2.0 * solid.radius_m
    elif isinstance(solid, Cylinder):
        part = entity.cylinders.add(bottom_scale=1.0, top_scale=1.0)
        part.size.x = part.size.y = 2.0 * solid.radius_m
        part.size.z = solid.length_m
    elif isinstance(solid, Polyline):
        part = entity.lines.add(thickness=_LINE_M)
        _add_points(part, solid.points_m)
    else:
        mesh = triangulated(solid)
        part = entity.triangles.add()
        _add_points(part, mesh.vertices_m)
        part.indices.extend(mesh.triangles.ravel().tolist())
    _put_pose(part.pose.position, part.pose.orientation, T)
    part.color.r, part.color.g, part.color.b, part.color.a = colour


def _add_points(part: Any, points: Array) -> None:
    for x, y, z in np.asarray(points).tolist():
        part.points.add(x=x, y=y, z=z)


def _put_stamp(stamp: Any, t_ns: int) -> None:
    stamp.seconds, stamp.nanos = divmod(t_ns, 1_000_000_000)


def _put_pose(position: Any, orientation: Any, T: Array) -> None:
    position.x, position.y, position.z = T[:3, 3].tolist()
    orientation.x, orientation.y, orientation.z, orientation.w = quaternion(T[:3, :3])


def _with_covariance(schema: bytes, name: str) -> bytes:
    files = descriptor_pb2.FileDescriptorSet.FromString(schema)
    (message,) = (each for file in files.file for each in file.message_type if each.name == name)
    message.field.add(
        name=COVARIANCE_FIELD,
        json_name=COVARIANCE_FIELD,
        number=_COVARIANCE_NUMBER,
        type=descriptor_pb2.FieldDescriptorProto.TYPE_DOUBLE,
        label=descriptor_pb2.FieldDescriptorProto.LABEL_REPEATED,
    )
    extended: bytes = files.SerializeToString(deterministic=True)
    return extended
