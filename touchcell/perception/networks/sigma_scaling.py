"""Calibrate predicted standard deviations to the errors of a validation set, as they would be in another session.

A validation set is one session, and it also chose the epoch. In another the skin slips a little earlier or later, and
camera and mount have moved: errors grow where the contact slips, and everything shifts a little. Such sessions are
simulated from the validation set's own errors, and the standard deviations are calibrated on all of them together.
"""

from __future__ import annotations

import math

import numpy as np

from touchcell.geometry.types import Array
from touchcell.perception.models.model_file import Labels

# Above one, the sigmas of contacts unlike those validated would grow faster than anything has shown.
_POWERS = np.arange(0.4, 1.0 + 1e-9, 0.02)
_SESSIONS = 40
# Magnitudes with which the intervals hold on a third session of the public data, where the validation set's own
# calibration covers 83 to 92 % instead of 95 %.
_SLIP_SD = 0.4
_TORSION_SLIP_SD = 0.5
_OFFSET_MM_DEG = np.array([0.2, 0.2, 0.04, 0.18, 0.18, 0.6])
_SLIPPING = 0.6
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


def other_sessions(labels: Labels, mean: Array, targets: Array, seed: int = 0) -> tuple[Array, Array]:
    """Return residuals of simulated other sessions, and of which validation image each is.

    In each session, shear and torsion that are left of a slipping contact are larger or smaller by one factor, as with
    another friction, and all components have an offset, as with another zero of the mount.

    Args:
        labels: of the model.
        mean: (n, 6) predicted, in label half-ranges.
        targets: (n, 6) labels, likewise.
        seed: of the sessions.

    Returns:
        (sessions * n, 6) residuals about the predictions, along ``labels.aligned``, and (sessions * n,) indices.
    """
    rng = np.random.default_rng(seed)
    predicted = labels.contacts(mean)
    shear = np.hypot(predicted[:, 0], predicted[:, 1])
    # The further beyond the onset, the more of the shear depends on friction.
    slips = np.clip(shear / np.maximum(predicted[:, 2], 1e-3) / _SLIPPING - 1.0, 0.0, 1.0)[:, None]
    residuals = []
    for _ in range(_SESSIONS):
        friction, twist = rng.normal(0.0, [_SLIP_SD, _TORSION_SLIP_SD])
        change = np.zeros_like(predicted)
        change[:, :2] = slips * friction * predicted[:, :2]
        change[:, 5] = slips[:, 0] * twist * predicted[:, 5]
        change += rng.normal(0.0, _OFFSET_MM_DEG)
        moved = mean + change / labels.half_range if labels.are_contacts else mean
        residuals.append(labels.aligned(targets - moved, mean))
    return np.concatenate(residuals), np.tile(np.arange(len(mean)), _SESSIONS)


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
