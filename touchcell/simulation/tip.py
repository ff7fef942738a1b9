"""The TacTip's skin: positions of its 331 markers in a contact, and their projection into the camera.

The deformation is a sum of smooth fields around the contact axis, which is the inward normal through the sphere's
centre; psi is a marker's angle from it. The forms are those that were necessary to fit real images
(docs/explanation/calibration.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import Array
from touchcell.simulation.relief import ReliefKernel, mirrored_samples

_MM = 1e-3
_DEG = math.pi / 180.0
_MIDDLING_DEPTH_M = 3.0 * _MM
_ROOT_MM = math.sqrt(_MM)
_MIRROR = np.array([1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, slots=True)
class TipParameters:
    """Parameters of one sensor: layout, camera and deformation of the skin. Angles in radians, lengths in metres.

    The defaults were fitted to 320 images of the public surface_3d training set, together with the mount's offset and
    level, and tested on 80 others: 99.3 % of the markers match a blob of the image within 12 px, at 2.5 px on average
    (1.2 px at depths below 1.5 mm, 3.3 px above 4.5 mm); the contact moves them by 14.5 px on average.

    Attributes:
        rings: marker rings around the central marker; ring k holds 6k.
        ring_step_rad: polar angle from ring to ring.
        layout_phase_rad: azimuth of each ring's first marker in the image.
        marker_radius_m: distance of the undeformed markers from the sphere's centre.
        camera_distance_m: from the pinhole to the sphere's centre, along z.
        focal_px: focal length.
        centre_px: (u, v) of the optical axis in the 640x480 frame; pixel centres are whole numbers.
        image_rotation_rad: rotation from sensor axes to image axes about z.
        mirrored: the camera sees the skin in a mirror: the image is reversed about its vertical axis.
        camera_tilt_rad: rotation of the markers about the sensor's x, then y axis, in the view of a camera whose
            optical axis is not the sensor's axis.
        disc_radius_px: radius of the markers in the image.
        follow: fraction of the shear that contacted markers follow.
        rim_follow: fraction of the shear at the far rim.
        shear_width_rad, shear_power: falloff exp(-(psi / width)^power) of shear and torsion.
        shear_width_growth_rad: increase of that width from 1 mm to 4 mm depth; it grows with the root of depth.
        rim_clamp: fraction of shear and torsion that the tip's body holds back at the outermost ring; it grows with the
            square of a marker's angle from the sensor's axis.
        torsion_follow: visible fraction of the torsion, at 3 mm depth.
        torsion_growth: power of depth by which that fraction grows.
        shear_twist: rotation of the skin by a shear across the slope of a tilted contact, whose patch is beside the
            sensor's axis, as a fraction of the angle that the shear spans at the marker radius.
        dent_follow: fraction of the depth by which the contacted skin moves in.
        dent_width_rad_per_sqrt_m, dent_power: falloff exp(-(psi / width)^power) of the dent. The width grows with the
            root of depth; the edge of a sphere's flattened cap would have sqrt(2 / tip radius), 10 rad per root metre.
        lean_follow: fraction of the dent's sideways part by which the whole dome leans, most at the apex.
        sink_follow: the same for the part along the sensor's axis.
        sink_growth_per_m: growth of both with depth beyond 3 mm.
        bulge: outward displacement around the contact, as a fraction of depth.
        bulge_at_rad, bulge_width_rad: angle of its maximum, and its width.
        rock: fraction of the shear by which skin ahead of it moves up, at full slope; negative moves it down.
        pin_lever_m: length of the pins that swing when the skin under them rotates.
    """

    rings: int = 10
    ring_step_rad: float = 7.75 * _DEG
    layout_phase_rad: float = -0.94 * _DEG
    marker_radius_m: float = 18.0 * _MM
    camera_distance_m: float = 41.58 * _MM
    focal_px: float = 501.1
    centre_px: tuple[float, float] = (331.05, 241.5)
    image_rotation_rad: float = -51.6 * _DEG
    mirrored: bool = False
    camera_tilt_rad: tuple[float, float] = (0.0, 0.0)
    disc_radius_px: float = 6.2
    follow: float = 1.0
    rim_follow: float = 0.20
    shear_width_rad: float = 58.0 * _DEG
    shear_power: float = 2.1
    shear_width_growth_rad: float = 0.0
    rim_clamp: float = 0.0
    torsion_follow: float = 0.6
    torsion_growth: float = 0.0
    shear_twist: float = 0.0
    dent_follow: float = 1.29
    dent_width_rad_per_sqrt_m: float = 11.6
    dent_power: float = 1.8
    lean_follow: float = 0.024
    sink_follow: float = 0.40
    sink_growth_per_m: float = 0.0
    bulge: float = 0.02
    bulge_at_rad: float = 63.0 * _DEG
    bulge_width_rad: float = 69.0 * _DEG
    rock: float = -0.77
    pin_lever_m: float = 0.89 * _MM


@dataclass(frozen=True, slots=True)
class SkinContact:
    """What the skin of any tip feels in a contact.

    Attributes:
        T_f_s: (4, 4) contact pose after slip.
        relief: (samples,) m, as ``Tip.marker_positions``; None on a plane.
    """

    T_f_s: Array
    relief: Array | None

    def mirrored(self) -> SkinContact:
        """Return the contact with a part and a way that are this one's in a mirror at the sensor's xz plane."""
        relief = None if self.relief is None else self.relief[mirrored_samples()]
        return SkinContact(mirrored(self.T_f_s), relief)


def mirrored(T: Array) -> Array:
    """Return pose ``T`` (4, 4) in a mirror at the xz planes of both frames."""
    image: Array = _MIRROR * T * _MIRROR[:, None]
    return image


class Tip:
    """Skin and camera of a sensor. All methods are vectorised, with results independent of the batch size.

    Args:
        parameters: parameters of the sensor.
        every: simulate only every so-many-th marker, for fits.
    """

    def __init__(self, parameters: TipParameters | None = None, *, every: int = 1) -> None:
        self.parameters = p = parameters or TipParameters()
        ring = np.concatenate([np.full(max(6 * k, 1), k) for k in range(p.rings + 1)])
        azimuth = np.concatenate([np.arange(max(6 * k, 1)) * 2.0 * np.pi / max(6 * k, 1) for k in range(p.rings + 1)])
        azimuth = azimuth[::every] + p.layout_phase_rad - p.image_rotation_rad
        polar = p.ring_step_rad * ring[::every]
        direction = [np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)]
        self._direction = np.stack(direction, axis=1)
        self._free = 1.0 - p.rim_clamp * (polar / (p.ring_step_rad * p.rings)) ** 2
        self._rest = p.marker_radius_m * self._direction
        self._relief: ReliefKernel | None = None

    @property
    def relief(self) -> ReliefKernel:
        """Where the skin feels the shape of a surface, and how markers follow."""
        if self._relief is None:
            self._relief = ReliefKernel(self._direction)
        return self._relief

    @property
    def rest_positions(self) -> Array:
        """Return (markers, 3) m, undeformed, in the sensor frame."""
        return self._rest.copy()

    def marker_positions(self, T_f_s: Array, relief: Array | None = None) -> Array:
        """Return marker positions in the sensor frame in contacts ``T_f_s``.

        Args:
            T_f_s: (..., 4, 4) contact poses after slip; those of negative depth leave the skin undeformed.
            relief: (..., samples) m, by how much further than a plane the surface presses into the skin at each of the
                samples of ``relief``; None for a plane.

        Returns:
            (..., markers, 3) m.
        """
        p = self.parameters
        R = T_f_s[..., :3, :3]
        depth = np.maximum(T_f_s[..., 2, 3], 0.0)[..., None]
        touching = (depth > 0.0).astype(np.float64)
        axis = R[..., 2, :]
        shear = -touching * (T_f_s[..., 0, 3, None] * R[..., 0, :] + T_f_s[..., 1, 3, None] * R[..., 1, :])
        torsion = touching * _torsion(R)[..., None]
        if p.torsion_growth:
            torsion = torsion * (depth / _MIDDLING_DEPTH_M) ** p.torsion_growth
        across = shear[..., 0, None] * axis[..., 1, None] - shear[..., 1, None] * axis[..., 0, None]
        torsion = torsion + p.shear_twist / p.marker_radius_m * across

        cos_psi = np.clip(axis @ self._direction.T, -1.0, 1.0)
        psi = np.arccos(cos_psi)
        root = np.sqrt(np.maximum(depth, 1e-9))
        shear_width = np.maximum(p.shear_width_rad + p.shear_width_growth_rad * (root / _ROOT_MM - 1.0), 0.1)
        grip = p.rim_follow + (1.0 - p.rim_follow) * np.exp(-((psi / shear_width) ** p.shear_power))
        grip = grip * self._free
        dent_width = p.dent_width_rad_per_sqrt_m * root
        reach = (psi / dent_width) ** p.dent_power
        dent = p.dent_follow * depth * np.exp(-reach)
        ahead = shear @ self._direction.T

        # Away from the contact axis, tangential to the sphere: sin(psi) long.
        outward = self._direction - cos_psi[..., None] * axis[..., None, :]
        # The dent's slope rotates the skin and swings the pins: lever * d(dent)/d(arc), along outward / sin(psi).
        slope = dent * p.dent_power * reach / (np.maximum(psi * np.sin(psi), 1e-9) * p.marker_radius_m)
        bulge = p.bulge * depth * np.exp(-(((psi - p.bulge_at_rad) / p.bulge_width_rad) ** 2))

        moved: Array = self._rest - dent[..., None] * axis[..., None, :]
        moved += (p.follow * grip)[..., None] * shear[..., None, :]
        moved += (bulge + p.pin_lever_m * slope)[..., None] * outward
        moved -= (p.torsion_follow * torsion * grip)[..., None] * (self._rest @ _turning(axis))
        sunk = depth * (1.0 + p.sink_growth_per_m * (depth - _MIDDLING_DEPTH_M))
        body = -sunk * axis * np.array([p.lean_follow, p.lean_follow, p.sink_follow])
        moved += (0.5 + 0.5 * self._direction[:, 2])[:, None] * body[..., None, :]
        moved[..., 2] += p.rock * ahead * grip
        if relief is not None:
            # The skin follows what it feels beyond a plane as it follows the plane, and its slope swings the pins.
            felt = p.dent_follow * relief
            moved -= self.relief.values(felt)[..., None] * axis[..., None, :]
            moved -= p.pin_lever_m / p.marker_radius_m * self.relief.slopes(felt)
        return moved

    def project(self, positions: Array) -> Array:
        """Project points (..., 3) m in the sensor frame to pixels (..., 2) in the 640x480 frame (pinhole camera)."""
        p = self.parameters
        if any(p.camera_tilt_rad):
            positions = positions @ _tilt(*p.camera_tilt_rad).T
        scale = p.focal_px / (p.camera_distance_m + positions[..., 2])
        sin, cos = math.sin(p.image_rotation_rad), math.cos(p.image_rotation_rad)
        x, y = positions[..., 0], positions[..., 1]
        across = scale * (cos * x - sin * y)
        u = p.centre_px[0] + (-across if p.mirrored else across)
        v = p.centre_px[1] + scale * (sin * x + cos * y)
        return np.stack([u, v], axis=-1)

    def pixels(self, T_f_s: Array, relief: Array | None = None) -> Array:
        """Return (..., markers, 2) px in the 640x480 frame, of contacts ``T_f_s`` (..., 4, 4); see
        ``marker_positions``."""
        return self.project(self.marker_positions(T_f_s, relief))


def _tilt(alpha: float, beta: float) -> Array:
    """Return (3, 3) Ry(beta) Rx(alpha)."""
    sin_a, cos_a, sin_b, cos_b = math.sin(alpha), math.cos(alpha), math.sin(beta), math.cos(beta)
    return np.array(
        [[cos_b, sin_b * sin_a, sin_b * cos_a], [0.0, cos_a, -sin_a], [-sin_b, cos_b * sin_a, cos_b * cos_a]]
    )


def _turning(axis: Array) -> Array:
    """Return (..., 3, 3) with ``points @ turning`` the cross product of ``axis`` (..., 3) and each point (n, 3)."""
    turning = np.zeros((*axis.shape, 3))
    x, y, z = axis[..., 0], axis[..., 1], axis[..., 2]
    turning[..., 1, 0], turning[..., 2, 0] = -z, y
    turning[..., 0, 1], turning[..., 2, 1] = z, -x
    turning[..., 0, 2], turning[..., 1, 2] = -y, x
    return turning


def _torsion(R: Array) -> Array:
    """Return gamma of R = Rz(gamma) Ry(beta) Rx(alpha), (...)."""
    gamma: Array = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    return gamma
