"""All interlocks, and the section of the cell file that sets their limits.

An interlock is a small frozen dataclass with a pure ``check`` over a ``CellView``, configured by a model whose keys
carry their units. None of them changes a command: they request slower motion or a stop. Interlocks with state are in
``touchcell.control.interlocks.timers`` and the modules named after what they monitor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from touchcell.control.interlocks.basic import (
    ArmStateAgeConfig,
    DepthConfig,
    FrameAgeConfig,
    TcpSpeedConfig,
    TiltConfig,
    WorkspaceConfig,
)
from touchcell.control.interlocks.clearance import ClearanceConfig
from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.motion import LimitedConfig, StandstillConfig, TrackingConfig
from touchcell.control.interlocks.pair import ObjectLostConfig, OutOfStepConfig, TopplingConfig
from touchcell.control.interlocks.planning_scene import PlanningScene, SpatialInterlockConfig
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
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array

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
"""One entry of the ``interlocks:`` section, discriminated by ``kind``."""

InterlocksConfig = dict[str, InterlockConfig]
"""The ``interlocks:`` section: settings by a user-chosen name."""


@dataclass(frozen=True, slots=True)
class InterlockSpec:
    """One kind of interlock, for ``touchcell list``.

    Attributes:
        kind: value of ``kind`` in the cell file.
        summary: one line.
        config: its settings; None for what is always on.
    """

    kind: str
    summary: str
    config: type[BaseModel] | None


REQUIRED_TO_MOVE: Final = frozenset({"workspace", "tcp_speed", "arm_state_age"})
"""Kinds that a task which moves an arm requires."""
REQUIRED_TO_TOUCH: Final = frozenset({"depth", "frame_age"})
"""Kinds that such a task also requires if it uses a tactile sensor."""

INTERLOCKS: Final[Mapping[str, InterlockSpec]] = MappingProxyType(
    {
        spec.kind: spec
        for spec in (
            InterlockSpec("finite", "every number is finite; always on, checked first", None),
            InterlockSpec("workspace", "sensor or tool stays inside a box in the arm's base frame", WorkspaceConfig),
            InterlockSpec("tcp_speed", "measured and commanded tool speed stay below limits", TcpSpeedConfig),
            InterlockSpec("depth", "no sensor is pressed in too deep", DepthConfig),
            InterlockSpec("frame_age", "tactile frames are fresh", FrameAgeConfig),
            InterlockSpec("arm_state_age", "arm states are fresh", ArmStateAgeConfig),
            InterlockSpec("tilt", "sensor or tool points along a direction within a cone", TiltConfig),
            InterlockSpec("frame_frozen", "tactile frames are not frozen: their content changes", FrameFrozenConfig),
            InterlockSpec("exposure", "brightness stays near that of the first frames", ExposureConfig),
            InterlockSpec("uncertain", "standard deviation of the depth is below a limit", UncertainConfig),
            InterlockSpec("out_of_range", "the estimate stays inside the network's training range", OutOfRangeConfig),
            InterlockSpec("inconsistent", "innovations match the filter's covariance", InconsistentConfig),
            InterlockSpec("contact_lost", "an established contact is not lost for long", ContactLostConfig),
            InterlockSpec("shear", "shear of every contact stays below saturation or slip", ShearConfig),
            InterlockSpec("torsion", "torsion of every contact stays below a limit", TorsionConfig),
            InterlockSpec("slip", "shear per depth of every contact stays below slip", SlipConfig),
            InterlockSpec("markers_lost", "most of the markers expected in view are detected", MarkersLostConfig),
            InterlockSpec("out_of_step", "leader and follower keep their distance and share the load", OutOfStepConfig),
            InterlockSpec("object_lost", "the object held by two sensors stays between them", ObjectLostConfig),
            InterlockSpec("toppling", "the pushed or held object does not begin to topple", TopplingConfig),
            InterlockSpec("tracking", "an arm follows its commanded velocity", TrackingConfig),
            InterlockSpec("standstill", "an arm that is commanded to stop stays at rest", StandstillConfig),
            InterlockSpec("clearance", "arms keep clear of each other, obstacles and themselves", ClearanceConfig),
            InterlockSpec("limited", "no gate limits an arm's command for long", LimitedConfig),
        )
    }
)


def parse_interlocks(section: Mapping[str, Any]) -> dict[str, InterlockConfig]:
    """Parse the ``interlocks:`` section.

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
    planning_scene: PlanningScene | None = None,
) -> tuple[Interlock | TimedInterlock, ...]:
    """Build the interlocks of a cell.

    Args:
        settings: by name.
        T_tcp_sensor: (4, 4) pose of each sensor in the tool frame, by role.
        planning_scene: base poses and collision bodies of the arms, and the obstacles.

    Raises:
        ConfigError: an interlock names an arm or a sensor that the cell does not have.
    """
    return tuple(
        config.build_in_scene(name, T_tcp_sensor, planning_scene or PlanningScene())
        if isinstance(config, SpatialInterlockConfig)
        else config.build(name, T_tcp_sensor)
        for name, config in settings.items()
    )
