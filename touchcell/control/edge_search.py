"""Find the middle of an object's flat side by touching its edges.

A round tip of radius R whose centre is beyond an edge, by less than R, touches the edge itself: the normal turns
inwards, and the edge is where the tip's surface is, along that normal. With the width of the side it tells where the
side's middle is, which no touch of the side itself tells. Both edges tell it better: what a model misreads of a normal
at one edge it misreads in the mirror at the other.

Where the side is known as a line, an edge is the point of it that is R less the depth from the tip's centre: arm
positions and depths tell it, and no normal, of which 1 deg would be 0.35 mm.
"""

from __future__ import annotations

import math
from typing import Final

from touchcell.control.push_model import Contact
from touchcell.control.push_steering import Pose

_BEYOND_M: Final = 0.006
"""Distance beyond the expected edge at which it is searched for."""
_STEP_M: Final = 0.011
"""Distance to the next attempt, doubled until the edge is between two: it is felt from 1.4 to 13 mm beside the tip's
centre."""
_EDGE_RAD: Final = math.radians(4.0)
"""Turn of the normal from which an edge is touched, and not the side."""
_INWARDS_RAD: Final = math.radians(14.0)
"""Turn of the tip towards the edge's normals: models know tilts to 25 degrees, and turning takes time."""
_APART_M: Final = 0.005
"""Distance up to which two contacts are with the same point of the object."""
_LINE_M: Final = 0.008
"""Distance of two contacts from which the line through them tells how their side is turned: points are 0.5 mm wrong."""
_MOST_TOUCHES: Final = 8
_LEAST_SINE: Final = 0.12
"""Sine of the normal's turn at an edge from which its distance tells where it is: depths are wrong by 0.03 mm."""


class EdgeSearch:
    """Search for one edge of a side; touches are made by the caller.

    Args:
        side: a contact with the side, or, unknown to the caller, with one of its edges.
        expected_m: of the side's middle to the left of that contact.
        width_m: of the side, as it is expected.
        tip_radius_m: radius of the tip.
        left: 1 for the left edge, -1 for the right one; the nearer one without it.
        edge: the other edge, where it has been found: then the side is known by it, and has not been touched itself.
    """

    def __init__(
        self,
        side: Contact,
        expected_m: float,
        width_m: float,
        tip_radius_m: float,
        *,
        left: float | None = None,
        edge: Pose | None = None,
    ) -> None:
        self._side = Pose(side.x_m, side.y_m, side.heading_rad)
        self._left = left or (-1.0 if expected_m > 0.0 else 1.0)
        self._half_m = 0.5 * width_m
        self._tip_radius_m = tip_radius_m
        self._at_m = self._left * expected_m + self._half_m + _BEYOND_M
        # Outwards: the farthest touch of the side, and the nearest attempt that touched nothing.
        self._flat_m: float | None = None
        self._missed_m: float | None = None
        self._step_m = _STEP_M
        self._touches = 0
        self._known_edge = edge
        self._edge = self._side
        self._edge_touch: Contact | None = None
        self.at_first: Contact | None = None
        """The touch of the edge, where it was at the first contact: this may have been with the edge, too."""
        self.middle: Contact | None = None
        """The side's middle, by the width that is expected; None until the edge has been found."""

    def opposite(self) -> EdgeSearch:
        """Return the search for the other edge, after this one has been found."""
        assert self.middle is not None
        width_m = 2.0 * self._half_m
        return EdgeSearch(self.middle, 0.0, width_m, self._tip_radius_m, left=-self._left, edge=self._edge)

    def between(self, other: EdgeSearch) -> tuple[Contact, float]:
        """Return the middle between the edges that two searches have found, and the distance of these."""
        right, left = (self, other) if other._left > 0.0 else (other, self)
        dx, dy = left._edge.x - right._edge.x, left._edge.y - right._edge.y
        x, y = 0.5 * (left._edge.x + right._edge.x), 0.5 * (left._edge.y + right._edge.y)
        return Contact(x, y, math.atan2(dy, dx) - 0.5 * math.pi), math.hypot(dx, dy)

    def edge_on(self, side: Pose) -> float | None:
        """Return where the edge is on a straight side, to the left of a point of it with the side's inward normal.

        None where the distance of the tip's centre does not tell, as of a first contact: much has been touched since.
        """
        touch = self._edge_touch
        if touch is None:
            return None
        apart_m = self._tip_radius_m - touch.depth_m
        tip = Pose(touch.x_m, touch.y_m, touch.heading_rad).ahead(-apart_m)
        ahead_m, left_m = side.local((tip.x, tip.y))
        beyond_m = math.sqrt(max(apart_m**2 - ahead_m**2, 0.0))
        return left_m - self._left * beyond_m if beyond_m > _LEAST_SINE * apart_m else None

    @property
    def left(self) -> float:
        """1 for the left edge, -1 for the right one."""
        return self._left

    @property
    def failed(self) -> bool:
        """True if the edge is not where it was searched for."""
        return self.middle is None and self._touches >= _MOST_TOUCHES

    def tip(self, clear_m: float) -> Pose:
        """Return where the tip's centre shall be for the next touch, before it moves on by ``clear_m`` and more."""
        at = self._side.ahead(-self._tip_radius_m - clear_m).ahead(self._left * self._at_m, 0.5 * math.pi)
        return Pose(at.x, at.y, at.heading - self._left * _INWARDS_RAD)

    @property
    def direction_rad(self) -> float:
        """Direction in which the tip moves on to touch."""
        return self._side.heading

    def touched(self, contact: Contact) -> None:
        """Take the point that was touched and its normal into account."""
        self._touches += 1
        turned = math.remainder(contact.heading_rad - self._side.heading, 2.0 * math.pi)
        if abs(turned) > _EDGE_RAD and self._lies_on_turned_side(contact, turned):
            if self._known_edge is not None:
                self._turn(self._known_edge, contact)
                return
            # The first contact was with the edge, whose normal is not the side's.
            edge, towards = self._side, Pose(contact.x_m, contact.y_m, contact.heading_rad)
            self._left = math.copysign(1.0, towards.local((edge.x, edge.y))[1])
            self._find(Pose(edge.x, edge.y, towards.heading), None)
        elif -self._left * turned > _EDGE_RAD and not self._is_other_edge(contact):
            if math.hypot(contact.x_m - self._side.x, contact.y_m - self._side.y) < _APART_M:
                self.at_first = contact
            self._find(Pose(contact.x_m, contact.y_m, self._side.heading), contact)
        else:
            self._flat_m = self._at_m
            self._step()

    def _lies_on_turned_side(self, contact: Contact, turned: float) -> bool:
        """Return True if a contact and the first one, or the other edge, lie on one straight side with its normal."""
        start = self._side if self._known_edge is None else self._known_edge
        ahead, left = Pose(start.x, start.y, self._side.heading).local((contact.x_m, contact.y_m))
        if abs(left) < _LINE_M:
            return False
        direction = math.atan2(-ahead * math.copysign(1.0, left), abs(left))
        return abs(direction - turned) < abs(direction)

    def _is_other_edge(self, contact: Contact) -> bool:
        known = self._known_edge
        return known is not None and math.hypot(contact.x_m - known.x, contact.y_m - known.y) < _LINE_M

    def _turn(self, edge: Pose, contact: Contact) -> None:
        """Search on along the line from the other edge to a contact with the side, which lies otherwise than was taken.

        The first contact was with that edge, whose normal is not the side's.
        """
        outwards = math.atan2(contact.y_m - edge.y, contact.x_m - edge.x)
        middle = Pose(edge.x, edge.y, outwards - self._left * 0.5 * math.pi)
        self._side = middle.ahead(self._left * self._half_m, 0.5 * math.pi)
        self._flat_m, self._missed_m = self._left * self._side.local((contact.x_m, contact.y_m))[1], None
        self._step_m = _STEP_M
        self._at_m = max(self._half_m + _BEYOND_M, self._flat_m + _STEP_M)

    def _find(self, edge: Pose, touch: Contact | None) -> None:
        self._edge_touch = touch
        self._edge, middle = edge, edge.ahead(-self._left * self._half_m, 0.5 * math.pi)
        self.middle = Contact(middle.x, middle.y, middle.heading)

    def missed(self) -> None:
        """Take into account that nothing was touched, or nothing that could be measured."""
        self._touches += 1
        self._missed_m = self._at_m
        self._step()

    def _step(self) -> None:
        match self._flat_m, self._missed_m:
            case float(), float():
                self._at_m = 0.5 * (self._flat_m + self._missed_m)
            case float(), None:
                self._at_m, self._step_m = self._flat_m + self._step_m, 2.0 * self._step_m
            case None, float():
                self._at_m, self._step_m = self._missed_m - self._step_m, 2.0 * self._step_m
