"""Interface of simulated scenes for the rest of a cell; simulators are found by entry point."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from pydantic import BaseModel

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.samples import Stamped
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.solids import Solid
from touchcell.geometry.types import Array
from touchcell.registry import Registry


@dataclass(frozen=True, slots=True)
class ContactState:
    """Contact of one sensor tip: sole input of the simulated image, and ground truth for it.

    Attributes:
        T_f_s: (4, 4) effective pose of the sensor in the surface frame, after slip; out of contact its z is minus the
            gap and it carries no shear.
        T_world_f: (4, 4) pose of the surface frame {f}.
        in_contact: whether the tip touches.
        slipping: whether the contact slid in the last step.
        normal_force_n: force on the tip along the surface normal.
        shear_force_n: force on the tip along the x and y axes of {f}; zero where the physics does not model it.
    """

    T_f_s: Array
    T_world_f: Array
    in_contact: bool
    slipping: bool
    normal_force_n: float
    shear_force_n: tuple[float, float] = (0.0, 0.0)

    @property
    def T_s_f(self) -> Array:  # noqa: N802  standard notation for transforms
        """(4, 4) pose of the surface frame in the sensor frame: the quantity that the network predicts."""
        return se3.inverse(self.T_f_s)

    @property
    def depth_m(self) -> float:
        """Indentation, negative out of contact."""
        return float(self.T_f_s[2, 3])

    @property
    def force_world_n(self) -> Array:
        """(3,) force on the tip along world axes."""
        force: Array = self.T_world_f[:3, :3] @ np.array([*self.shear_force_n, -self.normal_force_n])
        return force


class SceneTruth(Protocol):
    """Ground truth of a scene, in this process or in another."""

    def contact(self, sensor: str, t_ns: int | None = None) -> Stamped[ContactState]:
        """Return the contact state of ``sensor``."""
        ...

    def objects(self) -> Stamped[Mapping[str, Array]]:
        """Return T_world_object (4, 4) of every free object."""
        ...

    def edge(self, sensor: str, t_ns: int | None = None) -> Stamped[Array] | None:
        """Return T_s_e (4, 4) of the edge nearest to the tip of ``sensor``; None where no surface has edges.

        {e} has z along the inward normal of the face that the sensor is over, x away from that face across the edge, y
        along the edge, and its origin one tip radius outside the edge, as {f} has.
        """
        ...


class Scene(SceneTruth, Protocol):
    """A scene in this process, in which devices are mounted."""

    def has(self, sensor: str) -> bool:
        """Return whether ``sensor`` is mounted."""
        ...


@dataclass(frozen=True, slots=True)
class SceneBody:
    """Something in a scene to draw.

    Attributes:
        name: of the surface or object.
        solids: its parts, each with its pose (4, 4) in the body's frame.
        pose: returns its pose in the world (4, 4) at a time of the scene; that at the start for a free object.
        moves: whether a prescribed motion moves it.
        free: whether it is a free object, whose pose ``SceneTruth.objects`` gives.
    """

    name: str
    solids: tuple[tuple[Solid, Array], ...]
    pose: Callable[[float], Array]
    moves: bool = False
    free: bool = False


class SceneSection(BaseModel):
    """Base of the pydantic model of a ``scene:`` section."""

    def build(self, clock: Clock) -> Scene:
        """Build the scene; its motions start now."""
        raise NotImplementedError

    def bodies(self) -> Sequence[SceneBody]:
        """Return the bodies to draw."""
        return ()

    def modules(self) -> Mapping[str, tuple[str, str]]:
        """Return the optional modules that it needs, each with the key that asks for it and how to install it."""
        return {}

    def problems(self) -> Iterable[ConfigError]:
        """Return what is wrong with the files that it names; ``key`` of each is relative to the section."""
        return ()

    def pressed(self, tips: Mapping[str, Array]) -> Mapping[str, float]:
        """Return how deep (m) each tip that touches something at the start is in it.

        Args:
            tips: T_world_s (4, 4) of each sensor.
        """
        return {}

    def touches(self, T_world_s: Array) -> bool:
        """Return whether a tip at a pose (4, 4) may touch something, at the start or as something moves there."""
        return True

    def meets(self, T_world_s: Array, way_m: Array, depth_m: float = 0.0) -> bool:
        """Return whether a tip may touch something on a straight way, as the scene is at the start.

        Args:
            T_world_s: (4, 4) pose of the sensor where the way begins.
            way_m: (3,) along world axes.
            depth_m: depth that the contact has to reach.
        """
        return True

    def most_shear_m(self, depth_m: float) -> float | None:
        """Return the largest shear that a contact of a depth holds before it slides; None if that is not known."""
        return None

    def way_over(
        self,
        T_world_s: Array,
        direction_rad: float,
        distance_m: float,
        depth_m: float,
        reach_m: float,
        back_m: float,
    ) -> Array | None:
        """Return the way (n, 3), m, of a tip that approaches along its axis and then goes straight over the surface.

        None where it makes no contact, or what it touches moves.

        Args:
            T_world_s: (4, 4) pose of the sensor at the start.
            direction_rad: from the sensor's x axis towards its y axis.
            distance_m: along the surface.
            depth_m: of the contact.
            reach_m: within which it makes contact.
            back_m: how far it withdraws at the end; that is the last row.
        """
        return None

    def ride(self, T_world_s: Array, reach_m: float, lasts_s: float) -> Array | None:
        """Return the way (n, 3), m, of a tip that approaches along its axis and goes along with what it touches.

        None where it makes no contact, or nobody knows how that moves.

        Args:
            T_world_s: (4, 4) pose of the sensor at the start.
            reach_m: within which it makes contact.
            lasts_s: for so long.
        """
        return None

    def points_over(
        self, T_world_s: Array, points: Array, depth_m: float, reach_m: float, *, of_edges: bool = False
    ) -> Array | None:
        """Return where (n, 3), m, the tip is at points (n, 2), m, of the plane of its first contact.

        The result is (n, 2, 3): with each place the outward normal of the face that is touched, nan where none is; with
        ``of_edges`` also that from an edge which is touched from beyond its face. None where it makes no contact, or
        what it touches moves. The other arguments are those of ``way_over``.
        """
        return None

    def way_along_edge(
        self, T_world_s: Array, distance_m: float, reach_m: float, *, backward: bool = False
    ) -> Array | None:
        """Return the frames {e} (n, 4, 4) along the edge that a tip meets which approaches along its axis.

        The way ends where it leads back to where it began. None where it meets no edge, or what it touches moves.

        Args:
            T_world_s: (4, 4) pose of the sensor at the start.
            distance_m: along the edge.
            reach_m: within which it makes contact.
            backward: with the face to the right of the travel, seen from above it.
        """
        return None

    def has_edges(self) -> bool:
        """Return whether anything in it has an edge that could be followed."""
        return True

    def start_near(
        self, T_world_s: Array, reach_m: float, allowed: Callable[[Array], bool], *, on_edge: bool = False
    ) -> Array | None:
        """Return the pose (4, 4) of a sensor near that of a start, from which it comes upon something.

        None where the start itself will do, or no other one is known.

        Args:
            T_world_s: (4, 4) pose of the sensor at the start.
            reach_m: distance along its axis within which it has to make contact.
            on_edge: whether it has to be with an edge.
        """
        return None

    def edge_missed(self, T_world_s: Array, reach_m: float) -> str:
        """Return why the first contact is not one with an edge to follow; empty where it is, or that is not known."""
        return ""

    def remarks(self, starts: Mapping[str, Array], reach_m: float | None) -> Iterable[str]:
        """Return what a sensor cannot follow of it, in a line each.

        Args:
            starts: by the name of the sensor, its pose (4, 4) in the world at the start.
            reach_m: distance along its axis within which the task expects contact; None where it expects none.
        """
        return ()


@dataclass(frozen=True, slots=True)
class SceneSpec:
    """Entry point of a simulator.

    Attributes:
        name: name of the simulator.
        summary: one line for ``touchcell list``.
        section: pydantic model of the ``scene:`` section.
    """

    name: str
    summary: str
    section: type[SceneSection]


SCENES: Final = Registry("touchcell.scenes", "scene", SceneSpec)
"""All installed simulators."""


def scene_section() -> type[SceneSection]:
    """Return the pydantic model of ``scene:`` sections. Raises ConfigError if no simulator is installed."""
    return SCENES.load("simulated").section
