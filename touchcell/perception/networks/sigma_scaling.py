"""Making predicted standard deviations agree with the errors of a validation set."""

from __future__ import annotations

import numpy as np

from touchcell.geometry.types import Array

_POWERS = np.arange(0.4, 1.6, 0.02)


def calibrate(residual: Array, sigma: Array) -> tuple[Array, Array]:
    """Scale and power that make ``scale * sigma ** power`` the likeliest standard deviations of Gaussian residuals.

    A network is surer of what it is sure of, and less sure of the rest, than other data bear out: a power below one
    takes some of both back. Where sigma never varies, the power is one.

    Args:
        residual: (n, 6).
        sigma: (n, 6) predicted, uncalibrated.

    Returns:
        (6,) and (6,).
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
