"""Interlocks: pure rules over a ``CellView``, and the section of the cell file that sets their limits.

Each rule is a small frozen dataclass with a ``check``; each is configured by a model whose keys carry their units.
None of them changes a command: they say when motion has to slow down or to end. Rules that need a past are in
``touchcell.control.interlocks.timers`` and the modules named after what they watch.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, Protocol

import numpy as np
from pydantic import BaseModel, Field, PositiveFloat, TypeAdapter, ValidationError, model_validator

from touchcell.control.interlocks.clearance import ClearanceConfig
from touchcell.control.interlocks.motion import LimitedConfig, StandstillConfig, TrackingConfig
from touchcell.control.interlocks.pair import ObjectLostConfig, OutOfStepConfig, TopplingConfig
from touchcell.control.interlocks.planning_scene import PlacedSettings, Surroundings
from touchcell.control.interlocks.settings import GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.tactile import (
    ContactLostConfig,
    ExposureConfig,
    FrameFrozenConfig,
    InconsistentConfig,
    MarkersLostConfig,
    OutOfRangeConfig,
    ShearConfig,
    SlipConfig,
    TorsionConfig,
    UncertainConfig,
)
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.errors import ConfigError
from touchcell.geometry.finite import all_finite
from touchcell.geometry.types import Array


class Interlock(Protocol):
    """A rule. ``check`` is a pure function of the view; what it raises counts as a fault."""

    @property
    def name(self) -> str:
        """Its name in the cell file."""
        ...

    @property
    def severity(self) -> Severity:
        """What a violation asks for."""
        ...

    def check(self, view: CellView) -> Violation | None:
        """The worst violation in ``view``, or None."""
        ...


@dataclass(frozen=True, slots=True)
class Finite:
    """Every number in the view and in the commands is finite. Always on, and asked before all others."""

    name: str = "finite"
    severity: Severity = Severity.FAULT

    def check(self, view: CellView) -> Violation | None:
        for role, frame_seq, what, value in self._numbers(view):
            if not (math.isfinite(value) if isinstance(value, float) else all_finite(np.asarray(value))):
                reason = f"{what} is not finite"
                return Violation(self.name, self.severity, role, reason, view.now_ns, frame_seq=frame_seq)
        return None

    def _numbers(self, view: CellView) -> Iterator[tuple[str, int | None, str, Any]]:
        for role, arm in view.arms.items():
            if arm.command is not None:
                yield role, None, "commanded twist", arm.command.twist
                yield role, None, "commanded time-to-live", arm.command.ttl_s
            yield role, None, "measured pose", arm.state.value.T_base_tcp
            yield role, None, "measured twist", arm.state.value.twist
            if arm.joints is not None:
                yield role, None, "measured joint angles", arm.joints.value.q
        for role, sensor in view.sensors.items():
            for what, value in (
                ("depth", sensor.depth_m),
                ("depth deviation", sensor.sigma_depth_m),
                ("innovation", sensor.nis),
                ("shear", sensor.shear_m),
                ("torsion", sensor.torsion_rad),
                ("brightness", sensor.brightness),
                ("contact pose", sensor.T_s_f),
                ("share of markers", sensor.markers),
            ):
                if value is not None:
                    yield role, sensor.seq, what, value


@dataclass(frozen=True, slots=True, eq=False)
class Workspace:
    """A point of an arm's tool stays inside a box along the axes of the arm's base; motion back into it is allowed.

    Attributes:
        arm: role of the arm.
        T_tcp_point: pose (4, 4) of the guarded point in the tool frame: the sensor's, so that its length counts, or the
            identity.
        min_m: lower corner (3,).
        max_m: upper corner (3,).
    """

    name: str
    severity: Severity
    arm: str
    T_tcp_point: Array
    min_m: Array
    max_m: Array

    def check(self, view: CellView) -> Violation | None:
        arm = view.arms[self.arm]
        p = (arm.state.value.T_base_tcp @ self.T_tcp_point)[:3, 3]
        excess = np.maximum(self.min_m - p, p - self.max_m)
        axis = int(np.argmax(excess))
        if excess[axis] <= 0.0:
            return None
        v = arm.commanded_velocity(self.T_tcp_point)
        if v is not None and np.all(np.where(p > self.max_m, v < 0.0, np.where(p < self.min_m, v > 0.0, True))):
            return None
        limit = self.max_m[axis] if p[axis] > self.max_m[axis] else self.min_m[axis]
        reason = f"{'xyz'[axis]} = {1e3 * p[axis]:.1f} mm is outside the box, limit {1e3 * limit:g} mm"
        return Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=float(p[axis]), limit=float(limit), unit="m"
        )


@dataclass(frozen=True, slots=True, eq=False)
class Tilt:
    """The z axis of an arm's tool, or of the sensor on it, stays in a cone; motion back into it is allowed.

    Attributes:
        arm: role of the arm.
        axis_tcp: (3,) unit vector of the guarded axis in the tool frame.
        direction: (3,) unit vector of the cone's axis along base axes.
        limit_rad: half of the cone's opening.
    """

    name: str
    severity: Severity
    arm: str
    axis_tcp: Array
    direction: Array
    limit_rad: float

    def check(self, view: CellView) -> Violation | None:
        arm = view.arms[self.arm]
        axis = arm.state.value.T_base_tcp[:3, :3] @ self.axis_tcp
        tilt_rad = math.acos(max(-1.0, min(1.0, float(axis @ self.direction))))
        if tilt_rad <= self.limit_rad:
            return None
        twist = arm.commanded_twist()
        if twist is not None and float(np.cross(twist[3:], axis) @ self.direction) > 0.0:
            return None
        reason = f"tilted by {math.degrees(tilt_rad):.1f} deg, limit {math.degrees(self.limit_rad):g} deg"
        return Violation(
            self.name, self.severity, self.arm, reason, view.now_ns, value=tilt_rad, limit=self.limit_rad, unit="rad"
        )


@dataclass(frozen=True, slots=True)
class TcpSpeed:
    """No tool centre point moves, or is told to move, faster than the limits."""

    name: str
    severity: Severity
    limit_m_s: float
    limit_rad_s: float

    def check(self, view: CellView) -> Violation | None:
        worst: Violation | None = None
        worst_ratio = 1.0
        for role, arm in view.arms.items():
            twists = {"measured": arm.state.value.twist}
            if arm.command is not None:
                twists["commanded"] = arm.command.twist
            for source, twist in twists.items():
                for part, limit, unit in ((twist[:3], self.limit_m_s, "m/s"), (twist[3:], self.limit_rad_s, "rad/s")):
                    speed = math.sqrt(float(part @ part))
                    if speed > limit * worst_ratio:
                        worst_ratio = speed / limit
                        reason = f"{source} speed is {speed:.4g} {unit}, limit {limit:g} {unit}"
                        worst = Violation(
                            self.name, self.severity, role, reason, view.now_ns, value=speed, limit=limit, unit=unit
                        )
        return worst


@dataclass(frozen=True, slots=True)
class Depth:
    """No sensor is pressed in deeper than the limit."""

    name: str
    severity: Severity
    limit_m: float

    def check(self, view: CellView) -> Violation | None:
        depths = {role: s.depth_m for role, s in view.sensors.items() if s.depth_m is not None}
        role = max(depths, key=lambda r: depths[r], default=None)
        if role is None or depths[role] <= self.limit_m:
            return None
        return Violation(
            self.name,
            self.severity,
            role,
            f"pressed in by {1e3 * depths[role]:.2f} mm, limit {1e3 * self.limit_m:g} mm",
            view.now_ns,
            value=depths[role],
            limit=self.limit_m,
            unit="m",
            frame_seq=view.sensors[role].seq,
        )


@dataclass(frozen=True, slots=True)
class FrameAge:
    """Every sensor's newest frame is younger than the limit, and none comes from the future."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        stamps = {role: (sensor.t_frame_ns, sensor.seq) for role, sensor in view.sensors.items()}
        return _check_ages(self, "newest frame", stamps, view.now_ns)


@dataclass(frozen=True, slots=True)
class ArmStateAge:
    """Every arm's newest state is younger than the limit, and none comes from the future."""

    name: str
    severity: Severity
    limit_s: float

    def check(self, view: CellView) -> Violation | None:
        stamps = {role: (arm.state.t_ns, None) for role, arm in view.arms.items()}
        return _check_ages(self, "newest state", stamps, view.now_ns)


def _check_ages(
    rule: FrameAge | ArmStateAge, what: str, stamps: Mapping[str, tuple[int, int | None]], now_ns: int
) -> Violation | None:
    """The oldest of ``stamps`` (time and frame number by role) if it is too old, or one that lies in the future."""
    for role, (t_ns, seq) in sorted(stamps.items(), key=lambda item: item[1][0]):
        age_s = (now_ns - t_ns) * 1e-9
        if not 0.0 <= age_s <= rule.limit_s:
            reason = f"{what} is {1e3 * age_s:.1f} ms old, limit {1e3 * rule.limit_s:g} ms"
            return Violation(
                rule.name,
                rule.severity,
                role,
                reason,
                now_ns,
                value=age_s,
                limit=rule.limit_s,
                unit="s",
                frame_seq=seq,
            )
    return None


class WorkspaceConfig(GradedSettings):
    """Box for a sensor, or for the tool centre point of an arm without one, along the axes of the arm's base.

    ``margin_mm`` is how far outside the box nothing stands: a cell whose arm may overshoot by more is refused.
    """

    kind: Literal["workspace"]
    arm: str
    sensor: str | None = None
    min_mm: tuple[float, float, float]
    max_mm: tuple[float, float, float]
    margin_mm: PositiveFloat | None = None

    @model_validator(mode="after")
    def _corners_in_order(self) -> WorkspaceConfig:
        if not all(low < high for low, high in zip(self.min_mm, self.max_mm, strict=True)):
            raise ValueError(f"min_mm {list(self.min_mm)} is not below max_mm {list(self.max_mm)} in every axis")
        return self

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule. Raises ConfigError for a sensor that the cell does not have."""
        T_tcp_point = _guarded(name, self.sensor, T_tcp_sensor)
        min_m, max_m = 1e-3 * np.array(self.min_mm), 1e-3 * np.array(self.max_mm)
        return Workspace(name, self.level, self.arm, T_tcp_point, min_m, max_m)


def _guarded(name: str, sensor: str | None, T_tcp_sensor: Mapping[str, Array]) -> Array:
    """Pose (4, 4) of the sensor in the tool frame, or the identity. Raises ConfigError for one that is not there."""
    if sensor is None:
        return np.eye(4)
    if sensor not in T_tcp_sensor:
        raise ConfigError(
            f"the task has no sensor {sensor!r}",
            key=f"interlocks.{name}.sensor",
            value=sensor,
            hint=f"sensors: {', '.join(sorted(T_tcp_sensor)) or 'none'}",
        )
    return T_tcp_sensor[sensor]


class TiltConfig(GradedSettings):
    """Cone for the z axis of a sensor, or of the tool of an arm without one; ``direction`` is along base axes."""

    kind: Literal["tilt"]
    arm: str
    sensor: str | None = None
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    limit_deg: Annotated[float, Field(gt=0.0, le=180.0)]

    @model_validator(mode="after")
    def _has_direction(self) -> TiltConfig:
        if not any(self.direction):
            raise ValueError("direction is zero")
        return self

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule. Raises ConfigError for a sensor that the cell does not have."""
        axis = _guarded(name, self.sensor, T_tcp_sensor)[:3, 2]
        direction = np.array(self.direction) / np.linalg.norm(self.direction)
        return Tilt(name, self.level, self.arm, axis, direction, math.radians(self.limit_deg))


class TcpSpeedConfig(InterlockSettings):
    """Largest speeds of any tool centre point."""

    kind: Literal["tcp_speed"]
    limit_m_s: PositiveFloat
    limit_rad_s: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule."""
        return TcpSpeed(name, self.level, self.limit_m_s, self.limit_rad_s)


class DepthConfig(GradedSettings):
    """Deepest indentation of any sensor."""

    kind: Literal["depth"]
    limit_mm: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule."""
        return Depth(name, self.level, 1e-3 * self.limit_mm)


class FrameAgeConfig(InterlockSettings):
    """Oldest tactile frame."""

    kind: Literal["frame_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule."""
        return FrameAge(name, self.level, 1e-3 * self.limit_ms)


class ArmStateAgeConfig(InterlockSettings):
    """Oldest arm state."""

    kind: Literal["arm_state_age"]
    limit_ms: PositiveFloat

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> Interlock:
        """The rule."""
        return ArmStateAge(name, self.level, 1e-3 * self.limit_ms)


InterlockConfig = Annotated[
    WorkspaceConfig
    | TiltConfig
    | TcpSpeedConfig
    | DepthConfig
    | FrameAgeConfig
    | ArmStateAgeConfig
    | FrameFrozenConfig
    | ExposureConfig
    | UncertainConfig
    | OutOfRangeConfig
    | InconsistentConfig
    | ContactLostConfig
    | ShearConfig
    | TorsionConfig
    | TrackingConfig
    | StandstillConfig
    | LimitedConfig
    | SlipConfig
    | MarkersLostConfig
    | OutOfStepConfig
    | ObjectLostConfig
    | TopplingConfig
    | ClearanceConfig,
    Field(discriminator="kind"),
]
"""One entry of the ``interlocks:`` section; ``kind`` says which."""

InterlocksConfig = dict[str, InterlockConfig]
"""The ``interlocks:`` section: settings by a name that people choose."""


@dataclass(frozen=True, slots=True)
class InterlockSpec:
    """One kind of interlock, for ``touchcell list``.

    Attributes:
        kind: the word in the cell file.
        summary: one line.
        config: its settings; None for what is always on.
    """

    kind: str
    summary: str
    config: type[BaseModel] | None


REQUIRED_TO_MOVE: Final = frozenset({"workspace", "tcp_speed", "arm_state_age"})
"""Kinds that a cell must have for a task that moves an arm."""
REQUIRED_TO_TOUCH: Final = frozenset({"depth", "frame_age"})
"""Kinds that it must have besides when the task feels."""

INTERLOCKS: Final[Mapping[str, InterlockSpec]] = MappingProxyType(
    {
        spec.kind: spec
        for spec in (
            InterlockSpec("finite", "every number is finite; always on, asked before all others", None),
            InterlockSpec("workspace", "sensor or tool stays inside a box in the arm's base frame", WorkspaceConfig),
            InterlockSpec("tcp_speed", "measured and commanded tool speed stay below limits", TcpSpeedConfig),
            InterlockSpec("depth", "no sensor is pressed in too deep", DepthConfig),
            InterlockSpec("frame_age", "tactile frames are fresh", FrameAgeConfig),
            InterlockSpec("arm_state_age", "arm states are fresh", ArmStateAgeConfig),
            InterlockSpec("tilt", "sensor or tool points along a direction within a cone", TiltConfig),
            InterlockSpec("frame_frozen", "tactile pictures change, noise and all", FrameFrozenConfig),
            InterlockSpec("exposure", "brightness stays near that of the first frames", ExposureConfig),
            InterlockSpec("uncertain", "the depth is known well enough", UncertainConfig),
            InterlockSpec("out_of_range", "the network stays in the range that it was trained on", OutOfRangeConfig),
            InterlockSpec("inconsistent", "the filter's innovations fit its covariance", InconsistentConfig),
            InterlockSpec("contact_lost", "a contact that was made is not missing for long", ContactLostConfig),
            InterlockSpec("shear", "no contact is sheared until it saturates or slips", ShearConfig),
            InterlockSpec("torsion", "no contact is twisted too far", TorsionConfig),
            InterlockSpec("slip", "no contact is sheared further than its depth can hold", SlipConfig),
            InterlockSpec("markers_lost", "most of the markers expected in view are seen", MarkersLostConfig),
            InterlockSpec("out_of_step", "leader and follower keep their distance and share the load", OutOfStepConfig),
            InterlockSpec("object_lost", "what two sensors hold stays between them", ObjectLostConfig),
            InterlockSpec("toppling", "what is pushed or held does not begin to lean", TopplingConfig),
            InterlockSpec("tracking", "an arm moves as it was sent", TrackingConfig),
            InterlockSpec("standstill", "an arm that is told to stand does", StandstillConfig),
            InterlockSpec("clearance", "arms keep away from each other, obstacles and themselves", ClearanceConfig),
            InterlockSpec("limited", "no gate holds an arm back for long", LimitedConfig),
        )
    }
)


def parse_interlocks(section: Mapping[str, Any]) -> dict[str, InterlockConfig]:
    """The ``interlocks:`` section as settings.

    Raises:
        ConfigError: for the first entry that is unknown, incomplete, not positive or inverted, with its key.
    """
    try:
        return TypeAdapter(InterlocksConfig).validate_python(dict(section))
    except ValidationError as error:
        first = error.errors()[0]
        # pydantic puts the discriminator's value between the name and the key.
        path = [str(part) for i, part in enumerate(first["loc"]) if i != 1]
        raise ConfigError(
            first["msg"],
            key=".".join(["interlocks", *path]),
            value=first.get("input"),
            hint=f"kinds: {', '.join(kind for kind, spec in INTERLOCKS.items() if spec.config)}",
        ) from None


def build_interlocks(
    settings: Mapping[str, InterlockConfig],
    T_tcp_sensor: Mapping[str, Array],
    surroundings: Surroundings | None = None,
) -> tuple[Interlock | TimedInterlock, ...]:
    """The rules of a cell.

    Args:
        settings: by name.
        T_tcp_sensor: (4, 4) where each sensor sits, by role.
        surroundings: where arms stand and what they look like.

    Raises:
        ConfigError: a rule is about something that is not there.
    """
    return tuple(
        config.build_placed(name, T_tcp_sensor, surroundings or Surroundings())
        if isinstance(config, PlacedSettings)
        else config.build(name, T_tcp_sensor)
        for name, config in settings.items()
    )
