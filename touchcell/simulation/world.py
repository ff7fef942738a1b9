"""Physics of a simulated scene at one fidelity: contact states of tips and motion of free objects."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.timeline import Restore

DeferredContact = Callable[[], ContactState]
"""Contact of a tip at one step, computed on demand: most are never read."""


def computed(state: ContactState) -> DeferredContact:
    """Return a contact that is already computed."""
    return lambda: state


class World(Protocol):
    """Physics of one scene, stepped on its timeline after all arms have moved. Single-threaded."""

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Add ``sensor`` at ``T_world_s`` (4, 4) at ``t_s`` seconds of the scene; return its contact there."""
        ...

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, DeferredContact]:
        """Advance to ``t_s`` with each mounted sensor at its ``T_world_s`` (4, 4); return the contact of each."""
        ...

    def objects(self) -> Mapping[str, Array]:
        """Return T_world_object (4, 4) of every free object at the last step."""
        ...

    def snapshot(self) -> Restore:
        """Return a function that restores the state of the last step; no sensor may be mounted in between."""
        ...


class KinematicWorld:
    """Surfaces with prescribed motion, unaffected by contact; each tip touches the nearest.

    Args:
        surfaces: surfaces by name, at least one.
        law: contact law of every tip.

    Raises:
        ConfigError: no surface.
    """

    def __init__(self, surfaces: Mapping[str, Surface], law: ContactLaw) -> None:
        if not surfaces:
            raise ConfigError("the scene has no surface to touch", key="scene.surfaces")
        self.surfaces = dict(surfaces)
        self.law = law
        self._models: dict[str, ContactModel] = {}

    def mount(self, sensor: str, T_world_s: Array, t_s: float) -> ContactState:
        """Add ``sensor``; return its contact at ``T_world_s`` (4, 4) at ``t_s``."""
        self._models[sensor] = ContactModel(self.law)
        return self._contact_of(sensor, T_world_s, t_s)()

    def step(self, T_world_s: Mapping[str, Array], t_s: float) -> Mapping[str, DeferredContact]:
        """Return the contact of each sensor at ``t_s``."""
        return {sensor: self._contact_of(sensor, pose, t_s) for sensor, pose in T_world_s.items()}

    def objects(self) -> Mapping[str, Array]:
        """Return an empty mapping: there are no free objects."""
        return {}

    def snapshot(self) -> Restore:
        """Return a function that restores every contact."""
        contacts = [model.snapshot() for model in self._models.values()]

        def restore() -> None:
            for contact in contacts:
                contact()

        return restore

    def _contact_of(self, sensor: str, T_world_s: Array, t_s: float) -> DeferredContact:
        surfaces = list(self.surfaces.values())
        surface = surfaces[0]
        if len(surfaces) > 1:
            surface = min(surfaces, key=lambda each: each.nearest(T_world_s[:3, 3], t_s).distance_m)
        return self._models[sensor].advance(T_world_s, surface, t_s)
