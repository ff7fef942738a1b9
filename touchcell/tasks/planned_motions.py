"""What a task surely does with its arms and contacts, as far as its parameters say.

`touchcell check` holds it against limits, interlocks and the scene: what trips on it would trip in every run.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

from touchcell.geometry.types import Array

Key: TypeAlias = tuple[str | int, ...]
"""Key of the task's parameter that says so."""


@dataclass(frozen=True, slots=True)
class PlannedStart:
    """A speed that is commanded at once while the arm is at rest.

    Attributes:
        key: of the task's parameter.
        speed_m_s: of the sensor.
        distance_m: for which it is commanded at least.
        presses: True if it goes on along the sensor's axis until something is touched.
    """

    key: Key
    speed_m_s: float
    distance_m: float
    presses: bool = False


@dataclass(frozen=True, slots=True)
class PlannedTurn:
    """A turn of the sensor.

    Attributes:
        key: of the task's parameter.
        rate_rad_s: that it reaches.
        state: of the task meanwhile; empty if it is not known.
    """

    key: Key
    rate_rad_s: float
    state: str = ""


@dataclass(frozen=True, slots=True)
class PlannedContact:
    """A contact that is held.

    Attributes:
        key: of the task's parameter.
        lasts_s: for at least so long.
        state: of the task meanwhile; empty if it is not known.
        shear_m: by which it is sheared at least.
    """

    key: Key
    lasts_s: float
    state: str = ""
    shear_m: float = 0.0


@dataclass(frozen=True, slots=True)
class PlannedSlide:
    """A way over a surface, in contact.

    Attributes:
        key: of the task's parameter that says how far.
        distance_m: along the surface.
        direction_rad: from the sensor's x axis towards its y axis.
        speed_m_s: of the sensor.
        depth_m: of the contact.
        state: of the task meanwhile; empty if it is not known.
        corners_m: of a way that bends, in the plane of the first contact, along the sensor's x and y axes; it gets that
            far from its start somewhere. Empty for a straight one.
        way_m: points of the whole of such a way, a few millimetres apart.
        known: False where nothing says where it begins.
    """

    key: Key
    distance_m: float
    direction_rad: float
    speed_m_s: float
    depth_m: float
    state: str = ""
    corners_m: tuple[tuple[float, float], ...] = ()
    way_m: tuple[tuple[float, float], ...] = ()
    known: bool = True


@dataclass(frozen=True, slots=True, eq=False)
class PlannedHold:
    """A step that needs a contact that none of the steps before it makes.

    Attributes:
        key: of the step.
        T_base_tcp: (4, 4) where the tool is then; None where that is not known.
        after: what has left every contact, if anything has; empty if only the scene can say.
    """

    key: Key
    T_base_tcp: Array | None
    after: str = ""


@dataclass(frozen=True, slots=True)
class PlannedTime:
    """Something that takes a time at least, and has another at most.

    Attributes:
        key: of the parameter that allows less than it takes.
        takes_s: at least.
        allowed_s: at most.
        what: words for it.
        by_model: True if it takes that only where a model estimates the contacts.
    """

    key: Key
    takes_s: float
    allowed_s: float
    what: str
    by_model: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class PlannedTouch:
    """A straight way on which something has to be touched.

    Attributes:
        key: of the task's parameter that says how far.
        T_base_tcp: (4, 4) where the tool begins.
        way_m: (3,) of the sensor, along the axes of the arm's base.
        depth_m: that the contact has to reach; 0 for any.
    """

    key: Key
    T_base_tcp: Array
    way_m: Array
    depth_m: float = 0.0


@dataclass(frozen=True, slots=True)
class PlannedRide:
    """A contact that goes along with what it touches.

    Attributes:
        key: of the task's parameter that says how long.
        lasts_s: for so long.
    """

    key: Key
    lasts_s: float


@dataclass(frozen=True, slots=True)
class Impossible:
    """Something that the task cannot do.

    Attributes:
        key: of the task's parameter that asks for it.
        why: words for it.
        hint: remedy.
    """

    key: Key
    why: str
    hint: str


@dataclass(frozen=True, slots=True)
class PlannedRim:
    """A way along the edge that is met first, in contact.

    Attributes:
        key: of the task's parameter that says how far.
        distance_m: along the edge, at most.
        backward: with the face to the right of the travel, seen from above it.
        closes: the way has to lead back to where it began.
        tilts: the sensor stays normal to the face; otherwise as it was at the start.
    """

    key: Key
    distance_m: float
    backward: bool
    closes: bool
    tilts: bool


PlannedMotion: TypeAlias = (
    PlannedStart
    | PlannedTurn
    | PlannedContact
    | PlannedSlide
    | PlannedHold
    | PlannedTime
    | PlannedTouch
    | PlannedRide
    | PlannedRim
    | Impossible
)
