"""Calibrate predicted standard deviations to the errors of a validation set, and widen them for other sessions.

A validation set is one session, and it also chose the epoch. In another the skin slips a little earlier or later, and
camera and mount have moved: errors grow where the contact slips, and everything shifts a little. ``OTHER_SESSIONS`` is
that, in addition to the errors of the validation set.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np

from touchcell.geometry.types import Array
from touchcell.perception.models.model_file import Labels, SessionSpread

# Above one, the sigmas of contacts unlike those validated would grow faster than anything has shown.
_POWERS = np.arange(0.4, 1.0 + 1e-9, 0.02)

OTHER_SESSIONS: Final = SessionSpread(
    offset_mm_deg=(0.05, 0.05, 0.05, 0.15, 0.15, 0.1), slip=0.5, torsion_slip=0.7, free=0.6
)
"""Offsets as between the two public sessions, in which contacts that do not slip are biased by 0.03, 0.01, 0.06 mm and
0.05, 0.02, 0.01 deg; friction as it has to be on a third session (docs/decisions/0069-sigma-adds-the-session.md)."""

_DEGREES, _COMPONENTS = 4.0, 6
_SCALES = np.exp(np.linspace(np.log(0.2), 0.0, 60))


def calibrate(residual: Array, sigma: Array) -> tuple[Array, Array]:
    """Fit scale and power that make ``scale * sigma ** power`` the likeliest standard deviations of Gaussian residuals.

    On other data a network's confident predictions are overconfident and its uncertain ones underconfident: a power
    below one corrects both. Where sigma never varies, the power is one.

    Args:
        residual: (n, 6).
        sigma: (n, 6) predicted, uncalibrated.

    Returns:
        (6,) scale and (6,) power.
    """
    scales, powers = np.empty(6), np.ones(6)
    for i in range(6):
        tried = _POWERS if np.ptp(sigma[:, i]) > 0.0 else np.ones(1)
        # Given the power, the likeliest scale is the root mean square of the standardised residuals.
        candidates = sigma[:, i, None] ** tried
        scale = np.sqrt(((residual[:, i, None] / candidates) ** 2).mean(axis=0))
        cost = np.log(candidates).mean(axis=0) + np.log(np.maximum(scale, np.finfo(float).tiny))
        best = int(np.argmin(cost))
        scales[i], powers[i] = scale[best], tried[best]
    return scales, powers


def tail_scale(squares: Array) -> float:
    """Return the factor of the covariance that gives the likeliest scale of a Student-t with 4 degrees of freedom.

    Args:
        squares: (n,) squared Mahalanobis distances of labels under the Gaussian.
    """
    cost = [
        0.5 * _COMPONENTS * math.log(scale)
        + 0.5 * (_DEGREES + _COMPONENTS) * float(np.log1p(squares / (_DEGREES * scale)).mean())
        for scale in _SCALES
    ]
    return float(_SCALES[int(np.argmin(cost))])


def calibration(labels: Labels, mean: Array, sigma: Array, targets: Array) -> dict[str, Any]:
    """Return the header's fields for a network with these results on a validation set.

    Args:
        labels: of the model.
        mean, sigma: (n, 6) of the network, in label half-ranges.
        targets: (n, 6) labels, likewise.
    """
    residual = labels.aligned(targets - mean, mean)
    scale, power = calibrate(residual, sigma)
    variance = (scale * sigma**power) ** 2
    session = OTHER_SESSIONS if labels.are_contacts else None
    if session is not None:
        variance = variance + session.variance(labels.contacts(mean)) / labels.sigma_unit**2
    return {
        "sigma_scale": tuple(scale.tolist()),
        "sigma_power": tuple(power.tolist()),
        "session": session,
        "tail_scale": tail_scale((residual**2 / variance).sum(axis=1)),
    }
