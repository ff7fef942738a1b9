"""Sequences of contacts with slip that depends on the path: a tip that moves at random while it presses on a plane.

Single contacts are pressed and then sheared (``touchcell.simulation.samples``), so that their slip follows from where
they end. Here the tip goes from one random contact to the next without leaving the surface, and what the skin holds
follows from the whole way: it sticks, slides, sticks again elsewhere, and returns (``contact.ContactModel``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import PUBLIC_DEPTH_MM, random_poses
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.surfaces import Plane, Surface

_STEPS: Final = 3
"""Steps of the contact for each frame."""
_TOUCH_MM: Final = 0.3
_FIRST_DEPTH_MM: Final = 3.0


@dataclass(frozen=True)
class Sequence:
    """Frames of one contact, from first touch on.

    Attributes:
        T_f_s: (n, 4, 4) where the sensor is, from the surface frame of first touch: what an arm knows, and the label of
            collected data.
        held: (n, 4, 4) the contact that the skin holds, and shows.
        slipping: (n,) whether skin slipped since the frame before.
    """

    T_f_s: Array
    held: Array
    slipping: NDArray[np.bool_]


def random_sequence(
    frames: int,
    seed: int,
    law: ContactLaw,
    *,
    rate_hz: float = 30.0,
    leg_s: float = 0.6,
    depth_mm: tuple[float, float] = PUBLIC_DEPTH_MM,
    tilt_deg: float = 15.0,
) -> Sequence:
    """Move through random contacts over the ranges of the public data; the same for the same seed.

    Args:
        frames: number of frames, the first ones of which are out of contact and left out.
        seed: of the contacts.
        law: compliance and slip of the tip.
        rate_hz: of the frames.
        leg_s: time from one random contact to the next.
        depth_mm: smallest and largest depth.
        tilt_deg: radius of the disc of tilts.
    """
    legs = int(np.ceil(frames / (rate_hz * leg_s))) + 2
    corners = se3.to_euler_mm_deg(random_poses(legs, np.random.default_rng(seed), depth_mm, tilt_deg=tilt_deg))
    # Straight down to the first contact.
    corners[:2, [0, 1, 5]] = 0.0
    corners[0, 3:5] = corners[1, 3:5]
    corners[:2, 2] = -_TOUCH_MM, _FIRST_DEPTH_MM
    at = np.arange(frames * _STEPS) / (rate_hz * leg_s * _STEPS)
    leg, u = at.astype(int), (at % 1.0)[:, None]
    eased = u * u * (3.0 - 2.0 * u)
    T_f_s = se3.from_euler_mm_deg(corners[leg] + eased * (corners[leg + 1] - corners[leg]))

    model, surface = ContactModel(law), Surface(Plane())
    above = se3.from_euler_mm_deg(np.array([0.0, 0.0, 1e3 * law.tip_radius_m, 180.0, 0.0, 0.0]))
    states = [model.step(above @ T, surface, 0.0) for T in T_f_s]
    slipping = np.array([[state.slipping for state in states[k : k + _STEPS]] for k in range(0, len(states), _STEPS)])
    held = np.stack([state.T_f_s for state in states])[_STEPS - 1 :: _STEPS]
    touching = held[:, 2, 3] > 1e-3 * _TOUCH_MM
    first = int(touching.argmax())
    return Sequence(T_f_s[_STEPS - 1 :: _STEPS][first:], held[first:], np.asarray(slipping[first:].any(axis=1)))
