"""Calibrate predicted standard deviations to the errors of a validation set."""

from __future__ import annotations

import numpy as np

from touchcell.geometry.types import Array

_POWERS = np.arange(0.4, 1.6, 0.02)


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
