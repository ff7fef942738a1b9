"""What happens in a simulated scene at one fidelity: which tip feels what, and where free objects go."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore

Feeling = Callable[[], ContactState]
"""Works out what a tip felt at the step that made this, when somebody asks: nobody reads most of them."""


def known(state: ContactState) -> Feeling:
    """One that is worked out already."""
    return lambda: state


class World(Protocol):
    """Physics of one scene, stepped on its timeline after all arms have moved. One thread only."""

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Let ``sensor`` feel, at ``T_world_s`` (4, 4) at ``t_s`` seconds of the scene; returns what it feels there."""
        ...

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, Feeling]:
        """Go on to ``t_s``, at which each mounted sensor is at its ``T_world_s`` (4, 4); returns what each feels."""
        ...

    def objects(self) -> Mapping[str, Array]:
        """T_world_object (4, 4) of every free object at the last step."""
        ...

    def snapshot(self) -> Restore:
        """What puts it back as it is at the last step; no sensor may be mounted in between."""
        ...


class KinematicWorld:
    """Surfaces that move as they were told, whatever touches them; each tip touches the nearest.

    Args:
        surfaces: by name, at least one.
        law: how every tip gives and slips.

    Raises:
        ConfigError: there is no surface.
    """

    def __init__(self, surfaces: Mapping[str, Surface], law: ContactLaw) -> None:
        if not surfaces:
            raise ConfigError("the scene has no surface to touch", key="scene.surfaces")
        self.surfaces = dict(surfaces)
        self.law = law
        self._models: dict[str, ContactModel] = {}

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Let ``sensor`` feel; returns what it feels at ``T_world_s`` (4, 4) at ``t_s``."""
        self._models[sensor] = ContactModel(self.law)
        return self._feel(sensor, T_world_s, t_s)()

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, Feeling]:
        """What each sensor feels at ``t_s``."""
        return {sensor: self._feel(sensor, pose, t_s) for sensor, pose in T_world_s.items()}

    def objects(self) -> Mapping[str, Array]:
        """Nothing is free here."""
        return {}

    def snapshot(self) -> Restore:
        """What brings every contact back."""
        contacts = [model.snapshot() for model in self._models.values()]

        def restore() -> None:
            for contact in contacts:
                contact()

        return restore

    def _feel(self, sensor: str, T_world_s: Array, t_s: float) -> Feeling:
        surfaces = list(self.surfaces.values())
        surface = surfaces[0]
        if len(surfaces) > 1:
            surface = min(surfaces, key=lambda each: each.nearest(T_world_s[:3, 3], t_s).distance_m)
        return self._models[sensor].advance(T_world_s, surface, t_s)
