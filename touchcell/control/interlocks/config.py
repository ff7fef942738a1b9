"""Interlocks: pure rules over a ``CellView``, and the section of the cell file that sets their limits.

Each rule is a small frozen dataclass with a ``check``; each is configured by a model whose keys carry their units.
None of them changes a command: they say when motion has to slow down or to end. Rules that need a past are in
``touchcell.control.interlocks.timers`` and the modules named after what they watch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Annotated, Any, Final

from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from touchcell.control.interlocks.always_on import OverrunConfig
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
    | ClearanceConfig
    | OverrunConfig,
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
            InterlockSpec("missing", "every arm and sensor is in the view; always on", None),
            InterlockSpec("overrun", "no control cycle comes late; always on, with a limit of its own", OverrunConfig),
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
    planning_scene: PlanningScene | None = None,
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
        config.build_in_scene(name, T_tcp_sensor, planning_scene or PlanningScene())
        if isinstance(config, SpatialInterlockConfig)
        else config.build(name, T_tcp_sensor)
        for name, config in settings.items()
    )
