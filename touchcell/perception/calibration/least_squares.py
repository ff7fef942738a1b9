"""Robust nonlinear least squares with a prior, for some dozens of parameters. NumPy only."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from touchcell.geometry.types import Array

_STEP = 1e-4
_MOST_DAMPING = 1e8


def robust_fit(
    residuals: Callable[[Array], Array],
    start: Array,
    scale: Array,
    *,
    low: Array,
    high: Array,
    prior: float,
    soft: float,
    turns: int = 30,
    progress: Callable[[int, int], None] | None = None,
) -> Array:
    """Minimise residuals by Levenberg-Marquardt with the soft-L1 loss and a finite-difference Jacobian.

    Minimises sum 2 soft^2 (sqrt(1 + (r / soft)^2) - 1) + prior^2 |(x - start) / scale|^2 within bounds.

    Args:
        residuals: (n,) as a function of the parameters (k,).
        start: (k,) initial value and prior mean.
        scale: (k,) prior standard deviation of each parameter.
        low, high: (k,) bounds.
        prior: residual that one scale away from the start is worth.
        soft: larger residuals count linearly rather than squared.
        turns: largest number of iterations.
        progress: called with the iterations done and ``turns``.

    Returns:
        (k,) parameters.
    """
    x = np.clip(start, low, high)

    def cost(r: Array, at: Array) -> float:
        robust = 2.0 * soft**2 * np.sum(np.sqrt(1.0 + (r / soft) ** 2) - 1.0)
        return float(robust + np.sum((prior * (at - start) / scale) ** 2))

    r = residuals(x)
    least, damping = cost(r, x), 1e-3
    for turn in range(turns):
        steps = np.where(x + _STEP * scale > high, -_STEP, _STEP) * scale
        jacobian = np.stack([(residuals(x + np.eye(len(x))[i] * steps[i]) - r) / steps[i] for i in range(len(x))], 1)
        jacobian *= scale
        weight = 1.0 / np.sqrt(1.0 + (r / soft) ** 2)
        normal = jacobian.T @ (weight[:, None] * jacobian) + prior**2 * np.eye(len(x))
        gradient = jacobian.T @ (weight * r) + prior**2 * (x - start) / scale
        before = least
        while damping < _MOST_DAMPING:
            damped = normal + damping * np.diag(np.maximum(np.diag(normal), 1e-12))
            candidate = np.clip(x - scale * np.linalg.solve(damped, gradient), low, high)
            r_candidate = residuals(candidate)
            found = cost(r_candidate, candidate)
            if np.isfinite(found) and found < least:
                x, r, least = candidate, r_candidate, found
                damping = max(0.2 * damping, 1e-9)
                break
            damping *= 8.0
        if progress is not None:
            progress(turn + 1, turns)
        if before - least < 1e-5 * before:
            break
    return x
