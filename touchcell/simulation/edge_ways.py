"""Contacts on the way along the rim of a random part, as a tip that follows it meets them.

A controller does not meet contacts evenly. Past corners it is off in ways that go together: beyond the edge and not yet
turned, then turned and too far inside, with a skin that is dragged by the way that it has come. A simple controller on
a belief that errs glides along the rim; what it passes is a sample of that.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.contact import ContactLaw, ContactModel
from touchcell.simulation.edges import nearest_edge
from touchcell.simulation.relief import felt_relief
from touchcell.simulation.surfaces import Surface
from touchcell.simulation.tip import SkinContact, Tip

_FRAME_S: Final = 1.0 / 30.0
_LATE: Final = 1
"""Frames after which an estimate arrives."""
_EVERY: Final = 3
"""Frames from one sample to the next, which are alike."""
_SETTLED: Final = 4
"""Frames until the skin is dragged by the way."""
_SPEED_M_S: Final = (0.012, 0.032)
_GAIN_PER_S: Final = (6.0, 14.0)
_FASTEST_M_S: Final = 0.06
_FASTEST_RAD_S: Final = math.radians(180.0)
_STILL_RAD: Final = math.radians(45.0)
_REFERENCE: Final = (0.0, 0.0, 3.0, 0.0, 0.0, 0.0)
_REFERENCE_SPREAD: Final = (0.5, 0.0, 0.5, 1.5, 1.5, 2.0)
"""Of the contact that a way holds, mm and deg."""
_ASIDE: Final = 0.6
_ASIDE_MM: Final = 5.0
"""Share of the ways beside the edge, and how far: a network that has seen all in the middle says so of the others."""
_ERROR_SPREAD: Final = (0.6, 0.0, 0.15, 2.5, 2.5, 4.0)
"""Of the belief, mm and deg, which keeps its error over some frames."""
_LESS_OR_MORE: Final = (0.3, 1.0, 2.0)
"""Of it, from way to way: held well, and off by what only corners and steep faces bring about."""
_ERROR_KEPT: Final = 0.85
_UNTILTED: Final = 0.15
"""Of the ways, in which the tilt is left as it is, as tasks of two and three dimensions do."""


def contacts_on_way(
    surface: Surface, tip: Tip, law: ContactLaw, T_world_e: Array, rng: np.random.Generator, frames: int
) -> Iterator[tuple[Array, SkinContact]]:
    """Yield label (6,) mm and deg, and what the skin feels, of contacts on a way that begins at ``T_world_e``.

    It takes ``frames``, and ends early where contact or edge is lost. The label is the sensor's pose in the frame {e}
    nearest to it.
    """
    model, radius_m = ContactModel(law), law.tip_radius_m
    reference = np.array(_REFERENCE) + rng.normal(0.0, _REFERENCE_SPREAD)
    reference[0] += rng.uniform(-_ASIDE_MM, _ASIDE_MM) * (rng.random() < _ASIDE)
    forward, speed_m_s, gain = rng.choice([-1.0, 1.0]), rng.uniform(*_SPEED_M_S), rng.uniform(*_GAIN_PER_S)
    used = np.ones(6) if rng.random() >= _UNTILTED else np.array([1.0, 1.0, 1.0, 0.0, 0.0, 1.0])
    spread = rng.choice(_LESS_OR_MORE) * np.array(_ERROR_SPREAD)
    error = rng.normal(0.0, spread)
    T_world_s = se3.compose(T_world_e, se3.from_euler_mm_deg(reference + error))
    seen: list[Array] = []
    for i in range(frames):
        T_edge = nearest_edge([surface], T_world_s, 0.0, radius_m)
        state = model.step(T_world_s, surface, 0.0)
        if T_edge is None or not state.in_contact:
            return
        label = se3.to_euler_mm_deg(se3.compose(se3.inverse(T_edge), T_world_s))
        if i >= _SETTLED and (i - _SETTLED) % _EVERY == 0:
            relief = felt_relief(surface, T_world_s, 0.0, tip.relief.directions, radius_m)
            yield label, SkinContact(state.T_f_s, relief)
        error = _ERROR_KEPT * error + math.sqrt(1.0 - _ERROR_KEPT**2) * rng.normal(0.0, spread)
        seen.append(label + error)
        believed = seen[max(len(seen) - 1 - _LATE, 0)]
        V = used * _twist(believed, reference, gain, forward * speed_m_s)
        T_step = se3.exp(np.concatenate([np.zeros(3), _FRAME_S * V[3:]]))
        T_step[:3, 3] = _FRAME_S * V[:3]
        T_world_s = se3.compose(T_world_s, T_step)


def _twist(believed: Array, reference: Array, gain: float, speed_m_s: float) -> Array:
    """Return the twist (6,) of the sensor, m/s and rad/s, of a servo with errors of position and orientation."""
    along = reference.copy()
    along[1] = believed[1]
    E = se3.compose(se3.inverse(se3.from_euler_mm_deg(believed)), se3.from_euler_mm_deg(along))
    turn = se3.log(E)[3:]
    slower = math.cos(min(abs(math.radians(believed[5] - reference[5])) / _STILL_RAD, 1.0) * 0.5 * math.pi)
    V = np.concatenate([gain * E[:3, 3], gain * turn])
    V[:3] *= min(1.0, _FASTEST_M_S / max(float(np.linalg.norm(V[:3])), 1e-9))
    V[3:] *= min(1.0, _FASTEST_RAD_S / max(float(np.linalg.norm(V[3:])), 1e-9))
    V[:3] += E[:3, :3] @ np.array([0.0, slower * speed_m_s, 0.0])
    return V
