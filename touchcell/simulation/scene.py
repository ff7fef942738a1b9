"""A simulated scene: surfaces and objects to touch, and the contacts of sensors on simulated arms."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from pydantic import Field, PositiveFloat, model_validator

from touchcell.drivers.core.clock import Clock, VirtualClock
from touchcell.drivers.core.errors import DeviceError
from touchcell.drivers.core.protocols import TcpSource
from touchcell.drivers.core.samples import Stamped
from touchcell.drivers.core.scene import ContactState, SceneBody, SceneSection, SceneSpec
from touchcell.errors import ConfigError, TouchcellError
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.plugin_section import Section
from touchcell.simulation.ahead import (
    first_contact,
    points_over,
    remark_on_approach,
    remark_on_edge,
    start_near,
    way_along_edge,
    way_over,
)
from touchcell.simulation.bodies import scene_bodies
from touchcell.simulation.closed_forms import Box, Cylinder, Saddle
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.motions import Still
from touchcell.simulation.objects import ObjectConfig, TableConfig
from touchcell.simulation.quasi_static import QuasiStaticWorld
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.shape_spec import SurfaceConfig, SurfaceSection, SurfaceSpec
from touchcell.simulation.surfaces import Dome, Plane, Ramp, Shape, Sphere, Surface
from touchcell.simulation.timeline import DEFAULT_STEP_S, Phase, Restore, Timeline
from touchcell.simulation.world import DeferredContact, KinematicWorld, World, computed

HISTORY_S = 5.0
_RIDE_STEPS = 100
_RIM_STEP_M = 4e-3


class ContactNotKept(TouchcellError, LookupError):
    """Requested contact is outside the scene's history.

    Attributes:
        t_ns: requested time.
        oldest_ns, newest_ns: range of the history.
    """

    def __init__(self, t_ns: int, oldest_ns: int, newest_ns: int) -> None:
        super().__init__(f"no contact at {t_ns} ns is stored, only from {oldest_ns} to {newest_ns} ns")
        self.t_ns = t_ns
        self.oldest_ns = oldest_ns
        self.newest_ns = newest_ns


@runtime_checkable
class Carrier(Protocol):
    """A simulated arm that carries sensors."""

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the (4, 4) pose at the present step of the simulation; must not advance time."""
        ...


@runtime_checkable
class LoadReceiver(Protocol):
    """A simulated arm that yields to contact forces on its sensors."""

    def apply_force(self, force_world: Array, point_world: Array) -> None:
        """Apply ``force_world`` (3,) N at ``point_world`` (3,) m from now on."""
        ...


class MeasuredCarrier:
    """A measured arm as carrier, so that a simulated sensor is mounted on a real or an emulated arm.

    Where the arm reports nothing, because it is lost or not started, its last pose is used.

    Args:
        arm: source of its pose.
        T_world_base: (4, 4) pose of its base.
    """

    def __init__(self, arm: TcpSource, T_world_base: Array) -> None:
        self._arm = arm
        self._T_world_base = T_world_base
        self._T_base_tcp: Array | None = None

    def T_world_tcp(self) -> Array:  # noqa: N802  standard notation for transforms
        """Return the newest measured pose (4, 4). Raises DeviceError if there has never been one."""
        try:
            T_base_tcp = self._arm.tcp().value.T_base_tcp
        except DeviceError:
            if self._T_base_tcp is None:
                raise
        else:
            # Non-finite poses are for the supervisor to detect, not for the physics.
            if self._T_base_tcp is None or np.isfinite(T_base_tcp).all():
                self._T_base_tcp = T_base_tcp
        assert self._T_base_tcp is not None
        return self._T_world_base @ self._T_base_tcp


class Scene:
    """A world and the sensors that touch it. Single-threaded.

    The world is stepped on the timeline's fixed grid to the clock's present time whenever a contact or an arm is read.

    Args:
        world: physics of the scene; its time counts from the construction of the scene.
        clock: injected clock.
        step_s: step of the simulation grid.
        surfaces: those of the world, for what only pictures and edges need of them.
        tip_radius_m: of every tip.
        feels_shape: whether cameras show what curvature and edges change; see ``SceneConfig.feels``.
    """

    def __init__(
        self,
        world: World,
        clock: Clock,
        step_s: float = DEFAULT_STEP_S,
        surfaces: Sequence[Surface] = (),
        tip_radius_m: float = 0.020,
        feels_shape: bool = False,
    ) -> None:
        self.world = world
        self.surfaces = tuple(surfaces)
        self.tip_radius_m = tip_radius_m
        self.feels_shape = feels_shape
        self.timeline = Timeline(clock, step_s)
        self._start_ns = self.timeline.t_ns
        self._poses: dict[str, Callable[[], Array]] = {}
        self._load_receivers: dict[str, Callable[[Array, Array], None]] = {}
        # The last entry is of the timeline's present step, the one before it of the previous step.
        self._contacts: dict[str, deque[DeferredContact]] = {}
        self._kept = round(HISTORY_S * 1e9 / self.timeline.step_ns)
        self.timeline.add(Phase.CONTACT, self._step)
        self.timeline.keep(self._snapshot)

    def mount(
        self, sensor: str, pose: Callable[[], Array], apply_force: Callable[[Array, Array], None] | None = None
    ) -> None:
        """Mount ``sensor``.

        Args:
            sensor: name of the sensor.
            pose: returns T_world_s (4, 4) at the present step and must not advance time.
            apply_force: called after every step with the contact force (3,) N on the sensor and its point of
                application (3,) m, both in the world frame.
        """
        if sensor in self._poses:
            raise ConfigError(f"sensor {sensor!r} is mounted already", key="scene", value=sensor)
        t_ns = self.timeline.t_ns
        state = self.world.mount(sensor, pose(), self.seconds(t_ns))
        self._poses[sensor] = pose
        if apply_force is not None:
            self._load_receivers[sensor] = apply_force
        self._contacts[sensor] = deque([computed(state)], maxlen=self._kept)

    def has(self, sensor: str) -> bool:
        """Return whether ``sensor`` is mounted."""
        return sensor in self._poses

    def contact(self, sensor: str, t_ns: int | None = None) -> Stamped[ContactState]:
        """Return the contact of ``sensor`` now, or at ``t_ns`` (the step before it), at most HISTORY_S ago.

        Raises:
            ConfigError: no such sensor.
            ContactNotKept: ``t_ns`` is in the future or older than the history.
        """
        if sensor not in self._contacts:
            raise ConfigError(f"no sensor {sensor!r} is mounted", key="scene", value=sensor)
        now_ns = self.timeline.advance()
        contacts, step_ns = self._contacts[sensor], self.timeline.step_ns
        newest = now_ns // step_ns
        seq = newest if t_ns is None else t_ns // step_ns
        if not 0 <= newest - seq < len(contacts):
            raise ContactNotKept(seq * step_ns, (newest - len(contacts) + 1) * step_ns, now_ns)
        at = seq - newest - 1
        state = contacts[at]()
        contacts[at] = computed(state)
        return Stamped(state, seq * step_ns, seq)

    def relief(self, sensor: str, directions: Array, t_ns: int | None = None) -> Array | None:
        """Return (samples,) m what the tip of ``sensor`` feels besides a tangent plane, at the time of ``contact``.

        None where it touches a plane, an object or nothing. See ``relief.felt_relief``.
        """
        contact = self.contact(sensor, t_ns)
        if not contact.value.in_contact or not self.surfaces:
            return None
        T_world_s = contact.value.T_world_f @ contact.value.T_f_s
        t_s = self.seconds(contact.t_ns)
        found = [(each.nearest(T_world_s[:3, 3], t_s).distance_m, each) for each in self.surfaces]
        distance_m, surface = min(found, key=lambda each: each[0])
        if distance_m >= self.tip_radius_m:
            return None
        return felt_relief(surface, T_world_s, t_s, directions, self.tip_radius_m)

    def edge(self, sensor: str, t_ns: int | None = None) -> Stamped[Array] | None:
        """Return T_s_e (4, 4) of the edge nearest to the tip of ``sensor``, at the time that ``contact`` would.

        None where no surface has edges. See ``SceneTruth.edge`` for its frame.
        """
        contact = self.contact(sensor, t_ns)
        T_world_s = contact.value.T_world_f @ contact.value.T_f_s
        t_s = self.seconds(contact.t_ns)
        T_world_e = nearest_edge(self.surfaces, T_world_s, t_s, self.tip_radius_m)
        if T_world_e is None:
            return None
        # {e} glides along with the tip: of a tip that leans along the edge the apex is not under the middle.
        T_world_e[:3, 3] += float((T_world_s[:3, 3] - T_world_e[:3, 3]) @ T_world_e[:3, 1]) * T_world_e[:3, 1]
        return Stamped(se3.compose(se3.inverse(T_world_s), T_world_e), contact.t_ns, contact.seq)

    def objects(self) -> Stamped[Mapping[str, Array]]:
        """Return the present T_world_object (4, 4) of every free object."""
        t_ns = self.timeline.advance()
        return Stamped(self.world.objects(), t_ns, t_ns // self.timeline.step_ns)

    def snapshot(self) -> Restore:
        """Return a function that restores the world, its contacts and its arms to the present state at any later time.

        The clock continues: a surface with prescribed motion continues from its pose. Lifecycles and leases of devices
            are
        not affected.

        Raises (when called):
            ConfigError: a sensor was mounted since.
        """
        return self.timeline.snapshot()

    def begin_now(self) -> None:
        """Let the motions of the scene begin at the present step, not at its construction."""
        self._start_ns = self.timeline.t_ns

    def seconds(self, t_ns: int) -> float:
        """Return the time of the world at ``t_ns``."""
        return (t_ns - self._start_ns) * 1e-9

    def _step(self, t_ns: int) -> None:
        poses = {sensor: pose() for sensor, pose in self._poses.items()}
        for sensor, contacts in self.world.step(poses, self.seconds(t_ns)).items():
            self._contacts[sensor].append(contacts)
            if sensor in self._load_receivers:
                self._load_receivers[sensor](contacts().force_world_n, poses[sensor][:3, 3])

    def _snapshot(self) -> Callable[[int], None]:
        start_ns, world = self._start_ns, self.world.snapshot()
        contacts = {sensor: kept.copy() for sensor, kept in self._contacts.items()}

        def restore(later_ns: int) -> None:
            if contacts.keys() != self._contacts.keys():
                raise ConfigError("a sensor was mounted after the snapshot was taken", key="scene")
            self._start_ns = start_ns + later_ns
            self._contacts = {sensor: kept.copy() for sensor, kept in contacts.items()}
            world()

        return restore


@contextmanager
def physics_engine(key: str, value: str) -> Iterator[None]:
    """Guard imports that need MuJoCo. Raises ConfigError, with what to install, where it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise ConfigError(
            f"needs {error.name}, which is not installed",
            key=key,
            value=value,
            hint="pip install 'touchcell[physics]'",
        ) from None


class PlaneConfig(SurfaceConfig):
    """A flat plate: the plane z = 0 of its pose, outside towards +z."""

    kind: Literal["plane"]

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Plane()


class RampConfig(SurfaceConfig):
    """Flat, then bent over an arc to an incline along the pose's +x; see ``surfaces.Ramp``.

    Attributes:
        bend_radius_mm: radius of the arc.
        incline_deg: slope at its end, negative downwards.
    """

    kind: Literal["ramp"]
    bend_radius_mm: float = Field(gt=0.0)
    incline_deg: float = Field(gt=-90.0, lt=90.0)

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Ramp(self.bend_radius_mm * 1e-3, float(np.radians(self.incline_deg)))


class DomeConfig(SurfaceConfig):
    """A hemisphere on a plane, its centre at the pose's origin, rising towards +z.

    Attributes:
        radius_mm: radius of the hemisphere.
    """

    kind: Literal["dome"]
    radius_mm: float = Field(gt=0.0)

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Dome(self.radius_mm * 1e-3)


class SphereConfig(SurfaceConfig):
    """A ball about the pose's origin.

    Attributes:
        radius_mm: radius of the ball.
    """

    kind: Literal["sphere"]
    radius_mm: float = Field(gt=0.0)

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Sphere(self.radius_mm * 1e-3)


class BoxConfig(SurfaceConfig):
    """A box that stands on z = 0 of its pose, its centre on the z axis.

    Attributes:
        size_mm: along x, y and z.
    """

    kind: Literal["box"]
    size_mm: tuple[PositiveFloat, PositiveFloat, PositiveFloat]

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        x, y, z = self.size_mm
        return Box((1e-3 * x, 1e-3 * y, 1e-3 * z))


class CylinderConfig(SurfaceConfig):
    """A cylinder about z that stands on z = 0 of its pose.

    Attributes:
        radius_mm: radius of the cylinder.
        height_mm: its height.
    """

    kind: Literal["cylinder"]
    radius_mm: float = Field(gt=0.0)
    height_mm: float = Field(gt=0.0)

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Cylinder(1e-3 * self.radius_mm, 1e-3 * self.height_mm)


class SaddleConfig(SurfaceConfig):
    """A saddle without end: hollow along the pose's x, a ridge along its y; see ``closed_forms.Saddle``.

    Attributes:
        hollow_radius_mm: radius of the hollow section at the origin.
        ridge_radius_mm: radius of the other section there.
    """

    kind: Literal["saddle"]
    hollow_radius_mm: float = Field(gt=0.0)
    ridge_radius_mm: float = Field(gt=0.0)

    def shape(self) -> Shape:
        """Return the shape in its own frame."""
        return Saddle(1e-3 * self.hollow_radius_mm, 1e-3 * self.ridge_radius_mm)


class TipLawConfig(Section):
    """Contact law of every simulated tip of the scene; see ``contact.ContactLaw``.

    Attributes:
        radius_mm: radius of the tip.
        stiffness_n_mm: normal stiffness, N/mm.
    """

    radius_mm: float = Field(default=20.0, gt=0.0)
    stiffness_n_mm: float = Field(default=1.5, gt=0.0)
    friction: float = Field(default=0.9, gt=0.0, le=3.0, description="of the skin, where objects are free")
    slip_at_1mm_mm: float = Field(
        default=0.34, gt=0.0, le=3.0, description="shear that survives at 1 mm depth, fitted to real images"
    )
    slip_exponent: float = Field(default=1.83, ge=0.5, le=3.0, description="growth of that shear with depth")

    def build(self) -> ContactLaw:
        return ContactLaw(
            self.radius_mm * 1e-3,
            self.stiffness_n_mm * 1e3,
            self.friction,
            self.slip_at_1mm_mm * 1e-3,
            self.slip_exponent,
        )


class SceneConfig(Section, SceneSection):
    """The ``scene:`` section of a cell file. Poses are in the world frame.

    ``physics`` is the fidelity (docs/explanation/simulation.md). ``kinematic``: surfaces with prescribed motion,
    unaffected by contact. ``quasi_static``: in addition, objects slide on the table where tips push them, without
    inertia and always upright. ``dynamic``: MuJoCo moves free objects and soft tips, at steps of ``physics_step_ms``
    within ``step_ms``, the grid on which arms move and contacts are stored.

    Attributes:
        physics: fidelity, see above.
        surfaces: surfaces, by a name of one's own.
        objects: free objects, by a name of one's own.
        table: the table under the objects.
        tip: contact law of the simulated tips.
        step_ms: grid on which arms move and contacts are stored.
        physics_step_ms: step of the dynamics, a divisor of ``step_ms``.
        feels: what the simulated and emulated cameras of real drivers show: ``plane`` or ``shape``, as the key of
            ``sim_tactip``.
    """

    physics: Literal["kinematic", "quasi_static", "dynamic"] = "kinematic"
    surfaces: dict[str, SurfaceSection] = Field(default={})
    objects: dict[str, ObjectConfig] = Field(default={})
    table: TableConfig = TableConfig()
    tip: TipLawConfig = TipLawConfig()
    step_ms: float = Field(default=2.0, ge=0.1, le=10.0)
    physics_step_ms: float = Field(default=1.0, ge=0.05, le=5.0)
    feels: Literal["plane", "shape"] = "plane"

    @model_validator(mode="after")
    def _something_to_touch(self) -> SceneConfig:
        if not (self.surfaces or self.objects):
            raise ValueError("the scene has neither surfaces nor objects to touch")
        if self.physics == "kinematic" and self.objects:
            raise ValueError("free objects need physics other than kinematic")
        gravity = self.table.gravity_m_s2
        lowest = min((each.friction or self.table.coefficient for each in self.objects.values()), default=math.inf)
        if self.physics == "quasi_static" and math.hypot(*gravity[:2]) >= lowest * -gravity[2]:
            raise ValueError("table.tilt_deg is steeper than friction holds an object without inertia")
        steps = self.step_ms / self.physics_step_ms
        if self.physics == "dynamic" and abs(steps - max(round(steps), 1)) > 1e-6:
            raise ValueError(f"step_ms {self.step_ms:g} is not a multiple of physics_step_ms {self.physics_step_ms:g}")
        return self

    def bodies(self) -> Sequence[SceneBody]:
        """Return the table, surfaces and objects to draw."""
        return scene_bodies(self.surfaces, self.objects, self.table)

    def build(self, clock: Clock) -> Scene:
        """Build the scene; its motions start now."""
        surfaces = {name: config.build() for name, config in self.surfaces.items()}
        return Scene(
            self._world(surfaces),
            clock,
            self.step_ms * 1e-3,
            list(surfaces.values()),
            1e-3 * self.tip.radius_mm,
            self.feels == "shape",
        )

    def modules(self) -> Mapping[str, tuple[str, str]]:
        """Return MuJoCo for dynamic scenes, and what the surfaces need."""
        found = {"mujoco": ("physics", "pip install 'touchcell[physics]'")} if self.physics == "dynamic" else {}
        for name, surface in self.surfaces.items():
            found.update({module: (f"surfaces.{name}", how) for module, how in surface.modules().items()})
        return found

    def problems(self) -> Iterable[ConfigError]:
        """Yield what is wrong with the files of the surfaces."""
        for name, surface in self.surfaces.items():
            for problem in surface.problems():
                key = f"surfaces.{name}.{problem.key}"
                yield ConfigError(problem.reason, key=key, value=problem.value, hint=problem.hint)

    def pressed(self, tips: Mapping[str, Array]) -> Mapping[str, float]:
        """Return how deep each tip is in a surface or an object; {} for dynamic scenes, which take long to build."""
        if self.physics == "dynamic":
            return {}
        scene = self.build(VirtualClock())
        for sensor, T_world_s in tips.items():
            scene.mount(sensor, partial(np.asarray, T_world_s))
        depths_m = {sensor: float(scene.contact(sensor).value.T_f_s[2, 3]) for sensor in tips}
        return {sensor: depth_m for sensor, depth_m in depths_m.items() if depth_m > 0.0}

    def touches(self, T_world_s: Array) -> bool:
        """Return whether a tip at a pose (4, 4) touches a surface; True where anything moves."""
        radius_m, surfaces = 1e-3 * self.tip.radius_mm, self._still()
        near = (surface.nearest(T_world_s[:3, 3], 0.0).distance_m < radius_m for surface in surfaces)
        return not surfaces or any(near)

    def meets(self, T_world_s: Array, way_m: Array, depth_m: float = 0.0) -> bool:
        """Return whether a surface or an object is in the way of a tip; True where any moves by itself."""
        surfaces = {name: surface.build() for name, surface in self.surfaces.items()}
        if self.physics == "dynamic" or not all(isinstance(surface.motion, Still) for surface in surfaces.values()):
            return True
        bodies = list(surfaces.values())
        if isinstance(world := self._world(surfaces), QuasiStaticWorld):
            bodies = world.bodies
        length_m, height_m = float(np.linalg.norm(way_m)), 1e-3 * self.tip.radius_mm - depth_m
        return first_contact(bodies, T_world_s[:3, 3], way_m / max(length_m, 1e-9), height_m, length_m) is not None

    def most_shear_m(self, depth_m: float) -> float | None:
        """Return the shear with which a contact of a depth slides."""
        return self.tip.build().max_shear_m(depth_m)

    def way_over(
        self,
        T_world_s: Array,
        direction_rad: float,
        distance_m: float,
        depth_m: float,
        reach_m: float,
        back_m: float,
    ) -> Array | None:
        """Return the way over surfaces that stand still; None where anything moves, or nothing is touched."""
        if not (surfaces := self._still()):
            return None
        height_m = 1e-3 * self.tip.radius_mm - depth_m
        return way_over(surfaces, T_world_s, direction_rad, distance_m, height_m, reach_m, back_m)

    def ride(self, T_world_s: Array, reach_m: float, lasts_s: float) -> Array | None:
        """Return the way of a contact with a surface whose motion is prescribed, as if made at the start."""
        surfaces = [surface.build() for surface in self.surfaces.values()]
        if self.objects or len(surfaces) != 1:
            return None
        met = first_contact(surfaces, T_world_s[:3, 3], T_world_s[:3, 2], 1e-3 * self.tip.radius_mm, reach_m)
        if met is None:
            return None
        motion, start = surfaces[0].motion, np.append(met[0], 1.0)
        held = se3.inverse(motion.pose(0.0)) @ start
        return np.array([(motion.pose(t_s) @ held)[:3] for t_s in np.linspace(0.0, lasts_s, _RIDE_STEPS)])

    def points_over(
        self, T_world_s: Array, points: Array, depth_m: float, reach_m: float, *, of_edges: bool = False
    ) -> Array | None:
        """Return places and normals over what stands still; None where anything moves, or nothing is touched."""
        if not (surfaces := self._still()):
            return None
        height_m = 1e-3 * self.tip.radius_mm - depth_m
        return points_over(surfaces, T_world_s, points, height_m, reach_m, of_edges=of_edges)

    def way_along_edge(
        self, T_world_s: Array, distance_m: float, reach_m: float, *, backward: bool = False
    ) -> Array | None:
        """Return frames along an edge of surfaces that stand still; None where anything moves, or no edge is met."""
        step_m = -_RIM_STEP_M if backward else _RIM_STEP_M
        return way_along_edge(self._still(), T_world_s, 1e-3 * self.tip.radius_mm, reach_m, distance_m, step_m)

    def has_edges(self) -> bool:
        """Return whether a surface has an edge."""
        surfaces = [surface.build() for surface in self.surfaces.values()]
        return nearest_edge(surfaces, np.eye(4), 0.0, 1e-3 * self.tip.radius_mm) is not None

    def remarks(self, starts: Mapping[str, Array], reach_m: float | None) -> Iterable[str]:
        """Yield where the tip does not fit into a surface, and which sensor does not come upon one."""
        radius_m = 1e-3 * self.tip.radius_mm
        for name, surface in self.surfaces.items():
            for remark in surface.remarks(radius_m):
                yield f"scene.surfaces.{name}: {remark}"
        # A sensor may be there for a free object, which none of the surfaces is.
        if reach_m is None or self.objects:
            return
        surfaces = {name: surface.build() for name, surface in self.surfaces.items()}
        for sensor, T_world_s in starts.items():
            if ahead := remark_on_approach(surfaces, T_world_s, radius_m, reach_m):
                yield f"sensors.{sensor}: {ahead}"

    def start_near(
        self, T_world_s: Array, reach_m: float, allowed: Callable[[Array], bool], *, on_edge: bool = False
    ) -> Array | None:
        """Return a start near one that does not come upon a surface that stands still, or upon its edge."""
        surfaces = {name: surface.build() for name, surface in self.surfaces.items()}
        if self.objects or not all(isinstance(surface.motion, Still) for surface in surfaces.values()):
            return None
        return start_near(surfaces, T_world_s, 1e-3 * self.tip.radius_mm, reach_m, on_edge=on_edge, allowed=allowed)

    def edge_missed(self, T_world_s: Array, reach_m: float) -> str:
        """Return why the first contact with surfaces that stand still is not one with an edge."""
        return remark_on_edge(self._still(), T_world_s, 1e-3 * self.tip.radius_mm, reach_m) or ""

    def _still(self) -> Sequence[Surface]:
        """Return the surfaces of a scene in which nothing moves; none of any other."""
        surfaces = [surface.build() for surface in self.surfaces.values()]
        moves = self.objects or not all(isinstance(surface.motion, Still) for surface in surfaces)
        return () if moves else surfaces

    def _world(self, surfaces: Mapping[str, Surface]) -> World:
        if self.physics == "kinematic":
            return KinematicWorld(surfaces, self.tip.build())
        if self.physics == "quasi_static":
            objects = {name: config.build(self.table) for name, config in self.objects.items()}
            return QuasiStaticWorld(surfaces, objects, self.tip.build(), self.table)
        return self._dynamic_world(surfaces)

    def _dynamic_world(self, surfaces: Mapping[str, Surface]) -> World:
        with physics_engine("scene.physics", "dynamic"):
            from touchcell.simulation.dynamics import DynamicWorld
            from touchcell.simulation.dynamics_model import TipMechanics
        law = self.tip.build()
        tip = TipMechanics(law.tip_radius_m, law.stiffness_n_m, law.friction, law=law)
        objects = {name: config.build(self.table) for name, config in self.objects.items()}
        return DynamicWorld(
            surfaces,
            objects,
            1e-3 * self.table.height_mm,
            tip,
            1e-3 * self.physics_step_ms,
            self.table.gravity_m_s2,
            self.table.factor if self.table.patches else None,
        )


SPEC = SceneSpec("simulated", "surfaces and free objects, kinematic, quasi-static or dynamic", SceneConfig)

PLANE = SurfaceSpec("plane", "a flat plate", PlaneConfig)
RAMP = SurfaceSpec("ramp", "a flat that bends over an arc to an incline", RampConfig)
DOME = SurfaceSpec("dome", "a hemisphere on a plane", DomeConfig)
SPHERE = SurfaceSpec("sphere", "a ball", SphereConfig)
BOX = SurfaceSpec("box", "a box", BoxConfig)
CYLINDER = SurfaceSpec("cylinder", "a cylinder", CylinderConfig)
SADDLE = SurfaceSpec("saddle", "a saddle without end", SaddleConfig)
