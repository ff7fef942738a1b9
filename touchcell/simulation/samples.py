"""Random contacts of randomised simulated sensors, over the ranges of the public tactile data."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import PUBLIC_DEPTH_MM, random_poses
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.mount import MountModel
from touchcell.simulation.tip import Tip, TipParameters

_IMAGES_PER_TIP = 16
_ADDITIVE = {"centre_px", "image_rotation_rad", "layout_phase_rad", "camera_tilt_rad"}


@dataclass(frozen=True, slots=True)
class Variation:
    """Domain randomisation: variation of simulated sensors and images, so that a model does not overfit to one sensor.

    Attributes:
        parameters: relative standard deviation of the tip's parameters.
        turn_rad: standard deviation of the image's and the layout's rotation.
        shift_px: standard deviation of the image centre, in the frame.
        marker_px: standard deviation of each marker's position, in the frame.
        disc_radius: relative standard deviation of the discs' radius from image to image.
        missing: fraction of markers that are not visible.
        field: unmodelled deformation: standard deviation of a smooth displacement of the whole field, as a fraction of
            the markers' mean displacement.
        slip: relative standard deviation of the slip parameters of a mount, from one batch of contacts to the next.
    """

    parameters: float = 0.03
    turn_rad: float = 0.005
    shift_px: float = 0.7
    marker_px: float = 0.3
    disc_radius: float = 0.08
    missing: float = 0.003
    field: float = 0.0
    slip: float = 0.0


USUAL_VARIATION: Final = Variation(
    parameters=0.01, turn_rad=0.002, shift_px=0.3, marker_px=0.1, disc_radius=0.03, missing=0.002
)
"""What the simulated models that ship were trained on, and are judged on."""


@dataclass(frozen=True, slots=True)
class SampledContact:
    """One random contact of one random sensor.

    Attributes:
        T_f_s: (4, 4) label: after slip, or the commanded pose if there is a mount model.
        markers: (markers, 2) px of all markers, in the 640x480 frame and in the order of the lattice.
        seen: (markers,) which of them are visible.
        disc_radius_px: radius of the markers.
    """

    T_f_s: Array
    markers: Array
    seen: NDArray[np.bool_]
    disc_radius_px: float

    @property
    def pixels(self) -> Array:
        """(visible, 2) px of the visible markers."""
        return self.markers[self.seen]


def contacts(
    n: int,
    seed: int,
    *,
    depth_mm: tuple[float, float] = PUBLIC_DEPTH_MM,
    parameters: TipParameters | None = None,
    law: ContactLaw | None = None,
    rig: MountModel | None = None,
    variation: Variation | None = None,
    tips: Callable[[np.random.Generator], TipParameters] | None = None,
) -> Iterator[SampledContact]:
    """Yield ``n`` random contacts, the same for the same seed.

    Depth is uniform in ``depth_mm``, tilt in a 25 deg disc, shear in a 5 mm disc, torsion in +-5 deg; what the depth
    cannot hold slips, and the label is the remaining pose. With a ``rig`` the label is the commanded pose, as in
    collected data, and the mount model determines the remaining contact.

    Args:
        n: number of contacts.
        seed: seed of all randomness.
        depth_mm: smallest and largest depth.
        parameters: mean parameters of the sensors.
        law: slip of the tips.
        rig: mount model with its slip, in place of ``law``.
        variation: amount of variation.
        tips: draws the sensor, in place of ``parameters``.
    """
    rng = np.random.default_rng(seed)
    middle, law, variation = parameters or TipParameters(), law or ContactLaw(), variation or Variation()
    for start in range(0, n, _IMAGES_PER_TIP):
        count = min(_IMAGES_PER_TIP, n - start)
        tip = Tip(scattered(middle if tips is None else tips(rng), variation, rng))
        poses = random_poses(count, rng, depth_mm)
        if rig is None:
            T_f_s = np.stack([contact_at(pose, law).T_f_s for pose in poses])
            pixels = tip.pixels(T_f_s)
        else:
            T_f_s = poses
            pixels = tip.pixels(_slipping(rig, variation, rng).contact(poses))
        if variation.field:
            pixels += _smooth_fields(tip.project(tip.rest_positions), pixels, variation.field, rng)
        pixels += rng.normal(0.0, variation.marker_px, pixels.shape)
        seen = rng.random(pixels.shape[:2]) >= variation.missing
        radius = tip.parameters.disc_radius_px * (1.0 + rng.normal(0.0, variation.disc_radius, count))
        for i in range(count):
            yield SampledContact(T_f_s[i], pixels[i], seen[i], float(radius[i]))


def _slipping(rig: MountModel, variation: Variation, rng: np.random.Generator) -> MountModel:
    longer, steeper, looser = 1.0 + variation.slip * rng.normal(0.0, 1.0, 3)
    return replace(
        rig,
        slip_at_1mm_m=rig.slip_at_1mm_m * max(longer, 0.2),
        uphill=rig.uphill * steeper,
        torsion_release=rig.torsion_release * max(looser, 0.2),
    )


def _smooth_fields(rest: Array, pixels: Array, share: float, rng: np.random.Generator) -> Array:
    """Return (n, markers, 2) px: random third-degree polynomials over the lattice, growing with the displacements."""
    u, v = ((rest - rest.mean(axis=0)) / np.abs(rest - rest.mean(axis=0)).max()).T
    terms = np.stack([np.ones_like(u), u, v, u * v, u * u, v * v, u**3, v**3])
    size = share * np.linalg.norm(pixels - rest, axis=2).mean(axis=1)
    weights = rng.normal(0.0, 1.0, (len(pixels), 2, len(terms))) * size[:, None, None]
    fields: Array = np.einsum("nck,km->nmc", weights, terms)
    return fields


def scattered(middle: TipParameters, variation: Variation, rng: np.random.Generator) -> TipParameters:
    """Return the parameters of a random sensor about ``middle``."""
    changed = {
        each.name: getattr(middle, each.name) * (1.0 + rng.normal(0.0, variation.parameters))
        for each in fields(middle)
        if each.name not in _ADDITIVE | {"rings", "mirrored", "camera_distance_m", "focal_px", "ring_step_rad"}
        and getattr(middle, each.name)
    }
    u, v = middle.centre_px + rng.normal(0.0, variation.shift_px, 2)
    # Focal length and camera distance together set the scale: varied separately they would change it by too much.
    zoom = 1.0 + rng.normal(0.0, 0.3 * variation.parameters)
    nearer = 1.0 + rng.normal(0.0, variation.parameters)
    distance = middle.camera_distance_m * nearer
    to_apex = (distance + middle.marker_radius_m) / (middle.camera_distance_m + middle.marker_radius_m)
    return replace(
        middle,
        **changed,
        centre_px=(float(u), float(v)),
        image_rotation_rad=middle.image_rotation_rad + rng.normal(0.0, variation.turn_rad),
        layout_phase_rad=middle.layout_phase_rad + rng.normal(0.0, variation.turn_rad),
        camera_distance_m=distance,
        focal_px=middle.focal_px * zoom * to_apex,
    )


def analytic_displacements(reference: Array, rings: int, seed: int, n: int = 2000) -> Array:
    """Return (n, m, 2) px displacements of the simulated tip in random contacts, mapped to a sensor's lattice."""

    tip = Tip(TipParameters(rings=rings))
    poses = random_poses(n, np.random.default_rng(seed), (0.0, 6.5))
    law = ContactLaw()
    pixels = tip.pixels(np.stack([contact_at(pose, law).T_f_s for pose in poses]))
    rest = tip.project(tip.rest_positions)
    from_tip = (rest - rest.mean(axis=0)) @ np.array([1.0, 1j])
    to_sensor = (reference - reference.mean(axis=0)) @ np.array([1.0, 1j])
    turn = np.vdot(from_tip, to_sensor) / np.vdot(from_tip, from_tip)
    moved = ((pixels - rest) @ np.array([1.0, 1j])) * turn
    return np.stack([moved.real, moved.imag], axis=-1)
