"""Fit the simulated tip to a real one: camera, mount, slip and skin from labelled contacts with known markers.

The forms are those of ``touchcell.simulation.tip`` and ``touchcell.simulation.mount``. Prior knowledge is the start and
the expected deviation of tips from it (``_FREE``): a score of frames alone does not determine forty parameters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from touchcell.geometry.types import Array
from touchcell.perception.calibration.least_squares import robust_fit
from touchcell.perception.calibration.marked_data import MarkedContacts
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import lattice
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters

_SOFT_PX = 2.0
_PRIOR_PX = 6.0
_ROTATIONS = 16
_FIRST_TURNS = 12
_TURNS = 40
_EVERY = 3

# Parameter, its index in a tuple: expected deviation from the start, minimum, maximum.
_Free = dict[tuple[str, int | None], tuple[float, float, float]]
_CAMERA: _Free = {
    ("focal_px", None): (100.0, 50.0, 5000.0),
    ("camera_distance_m", None): (10e-3, 10e-3, 0.2),
    ("centre_px", 0): (5.0, 0.0, 2000.0),
    ("centre_px", 1): (5.0, 0.0, 2000.0),
    ("camera_tilt_rad", 0): (0.05, -0.4, 0.4),
    ("camera_tilt_rad", 1): (0.05, -0.4, 0.4),
    ("ring_step_rad", None): (0.005, 0.05, 0.155),
    ("layout_phase_rad", None): (0.02, -1.0, 1.0),
    ("image_rotation_rad", None): (0.2, -7.0, 7.0),
}
_SKIN: _Free = {
    ("follow", None): (0.1, 0.3, 1.5),
    ("rim_follow", None): (0.2, 0.0, 1.0),
    ("shear_width_rad", None): (0.2, 0.2, 2.5),
    ("shear_width_growth_rad", None): (0.3, -1.5, 1.5),
    ("shear_power", None): (0.5, 1.0, 6.0),
    ("rim_clamp", None): (0.4, -0.5, 1.0),
    ("torsion_follow", None): (0.3, 0.0, 2.0),
    ("torsion_growth", None): (1.5, 0.0, 4.0),
    ("shear_twist", None): (0.5, -2.0, 2.0),
    ("dent_follow", None): (0.4, 0.1, 3.0),
    ("dent_width_rad_per_sqrt_m", None): (3.0, 3.0, 25.0),
    ("dent_power", None): (0.6, 1.0, 6.0),
    ("lean_follow", None): (0.1, -0.5, 1.0),
    ("sink_follow", None): (0.3, -0.5, 1.5),
    ("sink_growth_per_m", None): (300.0, -1000.0, 2000.0),
    ("bulge", None): (0.1, -0.5, 1.0),
    ("bulge_at_rad", None): (0.3, 0.0, 1.6),
    ("bulge_width_rad", None): (0.3, 0.2, 2.0),
    ("rock", None): (0.4, -4.0, 2.0),
    ("pin_lever_m", None): (0.5e-3, -3e-3, 5e-3),
}
_RIG: _Free = {
    ("offset_m", 0): (2e-3, -8e-3, 8e-3),
    ("offset_m", 1): (2e-3, -8e-3, 8e-3),
    ("depth_m", None): (0.5e-3, -2e-3, 2e-3),
    ("level_rad", 0): (0.02, -0.2, 0.2),
    ("level_rad", 1): (0.02, -0.2, 0.2),
    ("press_slant", 0): (0.03, -0.2, 0.2),
    ("press_slant", 1): (0.03, -0.2, 0.2),
    ("give", 0): (0.04, -0.3, 0.3),
    ("give", 1): (0.04, -0.3, 0.3),
    ("slip_at_1mm_m", None): (0.2e-3, 0.01e-3, 3e-3),
    ("slip_exponent", None): (0.7, 0.5, 4.0),
    ("uphill", None): (0.3, -1.0, 1.5),
    ("torsion_release", None): (0.3, 0.2, 3.0),
    ("torsion_release_power", None): (0.7, 0.7, 6.0),
}
_FREE = {**_CAMERA, **_SKIN, **_RIG}
_FIRST = [
    ("focal_px", None),
    ("centre_px", 0),
    ("centre_px", 1),
    ("image_rotation_rad", None),
    ("dent_follow", None),
    ("sink_follow", None),
    ("offset_m", 0),
    ("offset_m", 1),
    ("depth_m", None),
]
_Key = tuple[str, int | None]


@dataclass(frozen=True)
class Sensor:
    """A simulated tip on its mount."""

    tip: TipParameters
    rig: MountModel

    def pixels(self, commanded: Array, *, every: int = 1) -> Array:
        """Return (n, markers, 2) px in commanded contacts (n, 4, 4)."""
        return Tip(self.tip, every=every).pixels(self.rig.contact(commanded))

    def errors(self, contacts: MarkedContacts) -> Array:
        """Return (n, m) px from simulated to measured markers, NaN for undetected ones."""
        off = np.linalg.norm(self.pixels(contacts.T_f_s) - contacts.pixels, axis=2)
        return np.where(contacts.seen, off, np.nan)


def fit_tip(
    contacts: MarkedContacts,
    reference: Array,
    rings: int,
    *,
    start: Sensor | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Sensor:
    """Fit the simulated sensor to the markers of a real one.

    Args:
        contacts: contacts to fit to; a score or more, over the range of depths, tilts and shears.
        reference: (m, 2) px lattice of the undeformed tip, markers in the order of ``markers.lattice``.
        rings: number of rings of the lattice.
        start: prior parameters for tips of this kind; its camera is mapped to the lattice anew.
        progress: called with the orientations tried so far and their total.

    Raises:
        TrainingError: fewer than 8 contacts, or no orientation of the camera explains them.
    """
    if len(contacts) < 8:
        raise TrainingError(f"{len(contacts)} contacts cannot separate camera from mount", hint="give 20 or more")
    start = start or Sensor(TipParameters(), MountModel())
    start = Sensor(_laid_onto(replace(start.tip, rings=rings), reference), start.rig)
    turned = [
        Sensor(replace(start.tip, image_rotation_rad=float(angle)), start.rig)
        for angle in np.arange(_ROTATIONS) * (2.0 * np.pi / _ROTATIONS) - np.pi
    ]
    turned.sort(key=lambda each: float(np.nanmean(each.errors(contacts))))
    first = [_fitted(each, contacts, _FIRST, _FIRST_TURNS, 0.3) for each in turned[:2]]
    best = min(first, key=lambda each: float(np.nanmean(each.errors(contacts))))
    moved = float(np.linalg.norm(contacts.pixels - reference, axis=2)[contacts.seen].mean())
    if not np.nanmean(best.errors(contacts)) < 0.6 * moved:
        raise TrainingError(
            "no orientation of the camera explains the observed marker motion",
            hint="check that labels and images match, and that the image is not mirrored",
        )
    return _fitted(best, contacts, list(_FREE), _TURNS, _PRIOR_PX, progress)


def _laid_onto(tip: TipParameters, reference: Array) -> TipParameters:
    """Return the tip with its camera moved so that the undeformed markers match a lattice."""
    flat = lattice(tip.rings) @ np.array([1.0, 1j])
    place = (reference - reference.mean(axis=0)) @ np.array([1.0, 1j])
    phase = float(np.angle(np.vdot(flat, place)))
    rest = Tip(tip).pixels(np.diag([1.0, 1.0, 1.0, 1.0]))
    spread = np.linalg.norm(rest - rest.mean(axis=0), axis=1).mean()
    zoom = np.abs(place).mean() / spread
    u, v = reference.mean(axis=0)
    return replace(
        tip,
        focal_px=float(tip.focal_px * zoom),
        disc_radius_px=float(tip.disc_radius_px * zoom),
        centre_px=(float(u), float(v)),
        layout_phase_rad=phase,
        camera_tilt_rad=(0.0, 0.0),
    )


def _fitted(
    start: Sensor,
    contacts: MarkedContacts,
    free: list[_Key],
    turns: int,
    prior_px: float,
    progress: Callable[[int, int], None] | None = None,
) -> Sensor:
    seen = contacts.seen[:, ::_EVERY, None]
    measured = contacts.pixels[:, ::_EVERY]

    def residuals(x: Array) -> Array:
        off = _with(start, free, x).pixels(contacts.T_f_s, every=_EVERY) - measured
        flat: Array = np.where(seen, off, 0.0).ravel()
        return flat

    scale, low, high = np.array([_FREE[key] for key in free]).T
    at = np.array([_value(start, key) for key in free])
    x = robust_fit(
        residuals, at, scale, low=low, high=high, prior=prior_px, soft=_SOFT_PX, turns=turns, progress=progress
    )
    return _with(start, free, x)


def _value(sensor: Sensor, key: _Key) -> float:
    name, place = key
    value = getattr(sensor.rig if key in _RIG else sensor.tip, name)
    return float(value if place is None else value[place])


def _with(sensor: Sensor, free: list[_Key], x: Array) -> Sensor:
    tip: dict[str, Any] = {}
    rig: dict[str, Any] = {}
    for key, value in zip(free, x, strict=True):
        name, place = key
        part, of = (rig, sensor.rig) if key in _RIG else (tip, sensor.tip)
        if place is None:
            part[name] = float(value)
        else:
            pair = list(part.get(name, getattr(of, name)))
            pair[place] = float(value)
            part[name] = tuple(pair)
    return Sensor(replace(sensor.tip, **tip), replace(sensor.rig, **rig))
