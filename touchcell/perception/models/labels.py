"""Labels: a contact in mm and degrees, and as the exponential coordinates that networks predict."""

from __future__ import annotations

import math

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array

CONTACT_NAMES = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
"""Components of a contact: extrinsic-xyz Euler pose T_f_s, sensor in surface frame (docs/glossary.md)."""

XI_UNITS = np.array([1e-3, 1e-3, 1e-3, np.pi / 180, np.pi / 180, np.pi / 180])
"""(6,) SI value of one millimetre or one degree, for every component of xi and of a contact."""

_ALONG_X = np.array([1.0, 0.0])
_NO_SHEAR_MM = 1e-6


def xi_from_contact(contact_mm_deg: Array) -> Array:
    """Return xi = log(T_s_f), m and rad, of contacts (..., 6) named as ``CONTACT_NAMES``."""
    return se3.log(se3.inverse(se3.from_euler_mm_deg(contact_mm_deg)))


def contact_from_xi(xi: Array) -> Array:
    """Return the contact (..., 6) named as ``CONTACT_NAMES``, of exponential coordinates of T_s_f, m and rad."""
    return se3.to_euler_mm_deg(se3.inverse(se3.exp(xi)))


def xi_gaussian(contact_mm_deg: Array, covariance: Array) -> tuple[Array, Array]:
    """Convert a Gaussian over contacts to one over xi = log(T_s_f), to first order.

    Args:
        contact_mm_deg: (..., 6) means, named as ``CONTACT_NAMES``.
        covariance: (..., 6, 6) mm and degrees.

    Returns:
        (..., 6) means and (..., 6, 6) covariances of xi, m and rad.
    """
    T_f_s = se3.from_euler_mm_deg(contact_mm_deg)
    xi = se3.log(se3.inverse(T_f_s))
    R_s_f = np.swapaxes(T_f_s[..., :3, :3], -1, -2)
    alpha = np.radians(np.asarray(contact_mm_deg)[..., 3])
    # T_f_s moves by a twist V of the sensor frame, hence T_s_f by -V from the left.
    twists = np.zeros((*alpha.shape, 6, 6))
    twists[..., :3, :3] = R_s_f
    twists[..., 3, 3] = 1.0
    twists[..., 4, 4], twists[..., 5, 4] = np.cos(alpha), -np.sin(alpha)
    twists[..., 3:, 5] = R_s_f[..., :, 2]
    jacobian = -se3.left_jacobian_inverse(xi) @ (twists * XI_UNITS)
    return xi, jacobian @ covariance @ np.swapaxes(jacobian, -1, -2)


def shear_direction(contact_mm_deg: Array) -> Array:
    """Return (..., 2) unit vectors along the shear (x, y) of contacts (..., 6); along x where there is none."""
    shear = np.asarray(contact_mm_deg)[..., :2]
    if shear.ndim == 1:
        # As in every frame: numbers take a fifth of the time of arrays.
        x, y = shear.tolist()
        length = math.hypot(x, y)
        return np.array([x / length, y / length]) if length > _NO_SHEAR_MM else _ALONG_X
    size = np.hypot(shear[..., :1], shear[..., 1:])
    return np.where(size > _NO_SHEAR_MM, shear / np.maximum(size, _NO_SHEAR_MM), _ALONG_X)
