"""Mount of a tip on a real arm: the contact that remains of the commanded one.

Labels of collected images (Algorithm 1 of the paper) are commands: tilt, press, shear. The actual contact differs by
the mount's offset, by the compliance of arm and mount, and by slip. The forms are those that fits to the public
surface_3d images needed; ``contact.ContactLaw`` is their simpler counterpart for contacts that are stepped in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchcell.geometry.types import Array

_MM = 1e-3
_SLIP_HARDNESS = 12.0  # 2.2 % below the sharp corner where the command equals the largest shear that sticks.
_STEEPEST = 0.3


@dataclass(frozen=True, slots=True)
class MountModel:
    """Mounting and slip of one sensor. The defaults are a perfect mount.

    Attributes:
        offset_m: (x, y) of the tilt centre of the arm, from the sensor's axis. Tilting then changes the depth.
        depth_m: offset added to commanded depths.
        level_rad: rotation of the surface about its x, then y axis, relative to the arm's assumption.
        press_slant: (x, y) shear per depth that pressing alone causes, as on a surface that is not level.
        give: (along, across) of the symmetric, traceless compliance [[a, c], [c, -a]] on lateral commands.
        slip_at_1mm_m: shear that survives at 1 mm depth.
        slip_exponent: growth of that shear with depth.
        uphill: depth lost per shear along a tilted contact's slope of 1.
        torsion_release: fraction of the largest shear, commanded, at which half of a torsion is lost.
        torsion_release_power: steepness of that loss.
    """

    offset_m: tuple[float, float] = (0.0, 0.0)
    depth_m: float = 0.0
    level_rad: tuple[float, float] = (0.0, 0.0)
    press_slant: tuple[float, float] = (0.0, 0.0)
    give: tuple[float, float] = (0.0, 0.0)
    slip_at_1mm_m: float = 0.34e-3
    slip_exponent: float = 1.83
    uphill: float = 0.0
    torsion_release: float = 1.0
    torsion_release_power: float = 2.0

    def contact(self, T_f_s: Array) -> Array:
        """Return the contacts that remain of commanded ones.

        Args:
            T_f_s: (..., 4, 4) commanded contacts.

        Returns:
            (..., 4, 4) actual contacts; out of contact there is no shear.
        """
        R, command = _turn(*self.level_rad) @ T_f_s[..., :3, :3], T_f_s[..., :3, 3]
        axis = R[..., 2, :]
        offset = axis[..., 0] * self.offset_m[0] + axis[..., 1] * self.offset_m[1]
        depth = command[..., 2] + self.depth_m + offset
        pressed = np.maximum(depth, 1e-6)

        along, across = self.give
        shear = command[..., :2] @ np.array([[1.0 + along, across], [across, 1.0 - along]])
        shear = shear + pressed[..., None] * np.array(self.press_slant)
        length = np.maximum(np.linalg.norm(shear, axis=-1), 1e-9)
        direction = (shear[..., 0, None] * R[..., 0, :] + shear[..., 1, None] * R[..., 1, :]) / length[..., None]
        slope = direction[..., 0] * axis[..., 0] + direction[..., 1] * axis[..., 1]
        longest = self.slip_at_1mm_m * (pressed / _MM) ** self.slip_exponent
        # s = s_max(depth - uphill * slope * s), to first order in the change of depth.
        relief = 1.0 + self.uphill * self.slip_exponent * slope * longest / pressed
        longest = longest / np.maximum(relief, _STEEPEST)
        share = (1.0 + np.minimum(length / longest, 1e6) ** _SLIP_HARDNESS) ** (-1.0 / _SLIP_HARDNESS)

        gamma = np.arctan2(R[..., 1, 0], R[..., 0, 0])
        excess = np.minimum(length / (self.torsion_release * longest), 1e6)
        held = gamma / (1.0 + excess**self.torsion_release_power)
        touching = depth > 0.0
        share, held = np.where(touching, share, 0.0), np.where(touching, held, 0.0)

        # The torsion that slipped rotated the skin over the surface, and did not change the shear's direction in the
        # sensor.
        back = _about_z(held - gamma)
        left = T_f_s.copy()
        left[..., :3, :3] = back @ R
        left[..., :2, 3] = np.einsum("...ij,...j->...i", back[..., :2, :2], shear) * share[..., None]
        left[..., 2, 3] = depth
        return left


def _turn(alpha: float, beta: float) -> Array:
    """Return (3, 3) Ry(beta) Rx(alpha)."""
    sin_a, cos_a, sin_b, cos_b = math.sin(alpha), math.cos(alpha), math.sin(beta), math.cos(beta)
    return np.array(
        [[cos_b, sin_b * sin_a, sin_b * cos_a], [0.0, cos_a, -sin_a], [-sin_b, cos_b * sin_a, cos_b * cos_a]]
    )


def _about_z(angle: Array) -> Array:
    R = np.zeros((*np.shape(angle), 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(angle)
    R[..., 1, 0] = np.sin(angle)
    R[..., 0, 1] = -R[..., 1, 0]
    R[..., 2, 2] = 1.0
    return R
