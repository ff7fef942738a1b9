"""The ``interlocks:`` section of the cell file.

Every interlock is a small frozen dataclass with a ``check``, configured by a model whose keys carry their units. An
interlock never changes a command: it reports when motion has to slow down or to stop. Its kind is an entry point of
the group ``touchcell.interlocks``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Final, TypeAlias

from pydantic import TypeAdapter, ValidationError

from touchcell.control.interlocks.interlock import Interlock
from touchcell.control.interlocks.planning_scene import PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.settings import InterlockSettings
from touchcell.control.interlocks.spec import INTERLOCKS
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.plugin_section import PluginSection

InterlocksConfig: TypeAlias = dict[str, Annotated[InterlockSettings, PluginSection(INTERLOCKS)]]
"""The ``interlocks:`` section: settings by a user-chosen name; ``kind`` names the interlock."""

REQUIRED_TO_MOVE: Final = frozenset({"workspace", "tcp_speed", "arm_state_age"})
"""Kinds that a task which moves an arm requires."""
REQUIRED_TO_TOUCH: Final = frozenset({"depth", "frame_age"})
"""Kinds that such a task also requires if it uses a tactile sensor."""
REQUIRED_TO_READ: Final = frozenset({"reading_age"})
"""Kinds that such a task also requires if it uses the readings of another device."""


def parse_interlocks(section: Mapping[str, Any]) -> dict[str, InterlockSettings]:
    """Parse the ``interlocks:`` section.

    Raises:
        ConfigError: for the first entry that is unknown, incomplete, not positive or inverted, with its key.
    """
    try:
        return TypeAdapter(InterlocksConfig).validate_python(dict(section))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(["interlocks", *(str(part) for part in first["loc"])])
        raise ConfigError(first["msg"], key=key, value=first.get("input")) from None


def build_interlocks(
    settings: Mapping[str, InterlockSettings],
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
