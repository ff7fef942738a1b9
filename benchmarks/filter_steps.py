"""One correction and one prediction at a time: run time against error of several methods."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from typing import Any, Literal

import numpy as np

from benchmarks import filter_rivals
from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian, mahalanobis_squared
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.filter_spec import ContactFilter
from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter

SIGMAS_RAD = (0.02, 0.05, 0.1, 0.2, 0.35)
LEVER_M = 0.02
"""Lever arm from rotation to translation standard deviations, about the radius of a tip."""

Correction = Callable[[PoseGaussian, PoseGaussian], PoseGaussian]

CORRECTIONS: dict[str, Correction] = {
    "Gauss-Newton, compiled": lambda prior, observation: gaussian.fuse(prior, observation)[0],
    "Gauss-Newton, numpy": filter_rivals.gauss_newton,
    "one-step EKF, numpy": filter_rivals.extended_kalman,
    "naive, numpy": filter_rivals.naive,
}


def corrections(draws: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return rows of method and sigma: time, distance from the optimum in posterior sigmas, and NEES of the truth.

    Prior and observation each miss the truth by a draw of their own covariance, so an exact product has a NEES of 6.
    """
    rows = []
    for sigma in SIGMAS_RAD:
        pairs = [_pair(sigma, np.random.default_rng((seed, k))) for k in range(draws)]
        best = [gaussian.fuse(prior, observed, tolerance=1e-9)[0] for _, prior, observed in pairs]
        for name, correct in CORRECTIONS.items():
            found = [correct(prior, observed) for _, prior, observed in pairs]
            distances = [mahalanobis_squared(b, f.mean) for b, f in zip(best, found, strict=True)]
            nees = [mahalanobis_squared(f, truth) for f, (truth, _, _) in zip(found, pairs, strict=True)]
            rows.append(
                {
                    "method": name,
                    "sigma_rad": sigma,
                    "us": 1e6 * _seconds(lambda c=correct, p=pairs: c(p[0][1], p[0][2])),  # type: ignore[misc]
                    "from_optimum_sigmas": float(np.sqrt(np.mean(distances))),
                    "nees": float(np.mean(nees)),
                    "nees_bound": float(1.96 * np.sqrt(12.0 / draws)),
                }
            )
    return rows


def predictions(draws: int, seed: int = 0) -> list[dict[str, Any]]:
    """Return rows of order and sigma: time, and the covariance's relative Frobenius error against ``draws`` samples.

    The last columns are the sampling error itself.
    """
    rows = []
    for sigma in SIGMAS_RAD:
        rng = np.random.default_rng(seed)
        U, mean = se3.exp(rng.normal(0.0, [0.02] * 3 + [0.5] * 3)), se3.exp(rng.normal(0.0, [0.02] * 3 + [0.5] * 3))
        P, Q = _covariance(sigma, rng), _covariance(0.7 * sigma, rng)
        moved_mean = se3.compose(U, mean)
        halves = [_sampled(moved_mean, U, mean, P, Q, draws // 2, rng) for _ in range(2)]
        exact = 0.5 * (halves[0] + halves[1])
        # In units of the standard deviations, so that metres and radians have equal weight.
        scale = 1.0 / np.sqrt(np.outer(np.diagonal(exact), np.diagonal(exact)))
        size = np.linalg.norm(exact * scale)
        left = 0.5 * float(np.linalg.norm((halves[0] - halves[1]) * scale) / size)
        orders: tuple[Literal[2, 4], ...] = (2, 4)
        for order in orders:
            prior = PoseGaussian(mean, P)

            def step(
                order: Literal[2, 4] = order, prior: PoseGaussian = prior, U: Array = U, Q: Array = Q
            ) -> PoseGaussian:
                return gaussian.compound(U, prior, Q, order)

            error = float(np.linalg.norm((step().covariance - exact) * scale) / size)
            rows.append({"order": order, "sigma_rad": sigma, "us": 1e6 * _seconds(step), "error": error, "left": left})
    return rows


def updates() -> dict[str, float]:
    """Return the CPU time of one whole update of each shipped filter, microseconds, from Python."""
    rng = np.random.default_rng(0)
    noise = isotropic_noise(1e-3, 0.01)
    observation = PoseGaussian(se3.exp(rng.normal(0.0, 0.01, 6)), _covariance(0.01, rng))
    poses = se3.exp(rng.normal(0.0, 0.01, (2, 6)))
    found = {}
    for name, pose_filter in (("still", PoseFilter(noise)), ("moving", MovingSurfaceFilter(noise, noise, noise))):
        frame = count()

        def step(pose_filter: ContactFilter = pose_filter, frame: Iterator[int] = frame) -> None:
            k = next(frame)
            pose_filter.update(observation, poses[k % 2], k * 33_000_000)

        found[name] = 1e6 * _seconds(step)
    return found


def _pair(sigma: float, rng: np.random.Generator) -> tuple[Array, PoseGaussian, PoseGaussian]:
    """Return the truth, and a prior and an observation that each miss it by a draw of their own covariance."""
    truth = se3.exp(rng.normal(0.0, [0.02] * 3 + [0.5] * 3))
    beliefs = []
    for scale in (1.0, 0.8):
        covariance = _covariance(scale * sigma, rng)
        e = np.linalg.cholesky(covariance) @ rng.normal(size=6)
        beliefs.append(PoseGaussian(se3.compose(se3.exp(-e), truth), covariance))
    return truth, beliefs[0], beliefs[1]


def _covariance(sigma: float, rng: np.random.Generator) -> Array:
    """Return a random full covariance with standard deviations of about ``sigma`` rad and ``sigma * LEVER_M`` m."""
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    spread = axes @ np.diag(rng.uniform(0.5, 1.5, 6) ** 2) @ axes.T
    units = sigma * np.array([LEVER_M] * 3 + [1.0] * 3)
    return np.asarray(spread * np.outer(units, units))


def _sampled(
    moved_mean: Array, U: Array, mean: Array, P: Array, Q: Array, draws: int, rng: np.random.Generator
) -> Array:
    """Return the covariance of exp(w) U exp(e) mean about U mean."""
    e = rng.normal(size=(draws, 6)) @ np.linalg.cholesky(P).T
    w = rng.normal(size=(draws, 6)) @ np.linalg.cholesky(Q).T
    T = se3.compose(se3.compose(se3.exp(w), U), se3.compose(se3.exp(e), mean))
    errors = se3.log(se3.compose(T, se3.inverse(moved_mean)))
    return np.asarray(errors.T @ errors / draws)


def _seconds(call: Callable[[], object], calls: int = 200) -> float:
    """Return the CPU time of one call, the best of five rounds."""
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for _ in range(calls):
            call()
        best = min(best, (time.process_time() - start) / calls)
    return best
