"""A contact as people write it (mm and degrees) and as networks predict it (exponential coordinates)."""

from __future__ import annotations

import numpy as np

from geometry import se3
from geometry.types import Array

CONTACT_NAMES = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
"""Components of a contact: extrinsic-xyz Euler pose T_f_s, sensor in surface frame (SPEC part 2)."""

XI_UNITS = np.array([1e-3, 1e-3, 1e-3, np.pi / 180, np.pi / 180, np.pi / 180])
"""(6,) one millimetre or one degree in SI, for every component of xi and of a contact."""


def xi_from_contact(contact_mm_deg: Array) -> Array:
    """xi = log(T_s_f), m and rad, of contacts (..., 6) named as ``CONTACT_NAMES``."""
    return se3.log(se3.inverse(se3.from_euler_mm_deg(contact_mm_deg)))


def contact_from_xi(xi: Array) -> Array:
    """Contact (..., 6) named as ``CONTACT_NAMES``, of exponential coordinates of T_s_f, m and rad."""
    return se3.to_euler_mm_deg(se3.inverse(se3.exp(xi)))
