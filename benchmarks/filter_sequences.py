"""Sequences of contacts with known motion, filtered (Lloyd & Lepora 2024, 5.3), and their statistics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.replay.dataset import natural_order, read_split
from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian, mahalanobis_squared
from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import random_poses
from touchcell.perception.models.labels import CONTACT_NAMES, XI_UNITS, contact_from_xi
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.runtime.estimators import load_estimator
from touchcell.perception.runtime.filter import PoseFilter
from touchcell.perception.runtime.filter_spec import FilterState

STEP_NS = 1_000_000_000
"""Time between two contacts, so that a noise density per second is one per contact."""

SYNTHETIC_SIGMA = np.array([0.3, 0.3, 0.12, 0.8, 0.8, 1.0]) * XI_UNITS
"""Standard deviations of the synthetic sensor's xi: similar to those of a good network without slip."""


@dataclass(frozen=True)
class ContactSequence:
    """n contacts of one sensor with one surface, in order.

    Attributes:
        T_base_s: (n, 4, 4) true sensor poses.
        T_s_f: (n, 4, 4) true contacts.
        observed: Gaussians of the single frames.
        xi: (n, 6) and
        sigma: (n, 6), the means and standard deviations of xi that they came from, m and rad.
        in_range: (n,) as reported by the estimator.
    """

    T_base_s: Array
    T_s_f: Array
    observed: tuple[PoseGaussian, ...]
    xi: Array
    sigma: Array
    in_range: NDArray[np.bool_]

    def shuffled(self, seed: int) -> ContactSequence:
        """Return the same contacts in another order.

        A labelled surface is static, so any order is a possible motion.
        """
        order = np.random.default_rng(seed).permutation(len(self.observed))
        return ContactSequence(
            self.T_base_s[order],
            self.T_s_f[order],
            tuple(self.observed[i] for i in order),
            self.xi[order],
            self.sigma[order],
            self.in_range[order],
        )


@dataclass(frozen=True)
class Track:
    """Estimates of a filter, or of the single frames, for a sequence.

    Attributes:
        contact: (n, 6) estimated contacts, mm and degrees, named as ``CONTACT_NAMES``.
        sigma: (n, 6) standard deviations of xi, m and rad.
        nees: (n,) squared Mahalanobis distances of the truth, 6 degrees of freedom.
        nis: (n - 1,) normalised innovations squared, or empty.
    """

    contact: Array
    sigma: Array
    nees: Array
    nis: Array


def labelled(
    data: Path, split: str, model: Path, progress: Callable[[int, int], None], *, torn_every: int = 0
) -> ContactSequence:
    """Return a labelled split as a sequence in the order of its images' names; the sensor moves as the labels.

    Args:
        data: data set.
        split: train, val or test.
        model: model file.
        progress: called with the images done and the total.
        torn_every: of so many images, one arrives with its lower half black; 0 for none.

    Raises:
        DataError, ModelError, ImageError: as ``touchcell.perception.networks.evaluate.evaluate``.
    """
    split_data = read_split(data, split)
    estimator = load_estimator(model)
    predictions = []
    for i, image in enumerate(split_data.read()):
        if torn_every and i % torn_every == torn_every - 1:
            image = image.copy()
            image[len(image) // 2 :] = 0
        predictions.append(estimator.predict(image))
        progress(len(predictions), len(split_data.images))
    order = sorted(range(len(predictions)), key=lambda i: natural_order(split_data.images[i]))
    # The base is the surface frame, as in touchcell.drivers.replay.arm.
    T_f_s = se3.from_euler_mm_deg(split_data.contact_mm_deg[order])
    return _sequence(T_f_s, se3.inverse(T_f_s), [predictions[i] for i in order])


def synthetic(
    n: int, seed: int, drift: float, *, slip_fraction: float = 0.0, outlier_fraction: float = 0.0
) -> ContactSequence:
    """Return random contacts over the public data's ranges, observed by a sensor with exactly Gaussian errors.

    Args:
        n: contacts.
        seed: of everything random.
        drift: standard deviation of the surface's own random walk per contact, in mm and degrees.
        slip_fraction: fraction of contacts before which the surface frame jumps by 1 mm and 2 deg in x, y, gamma.
        outlier_fraction: fraction of frames whose errors are six times their predicted size.
    """
    rng = np.random.default_rng(seed)
    T_base_s = random_poses(n, rng)
    T_s_f = np.empty((n, 4, 4))
    T_base_f = np.eye(4)
    for k in range(n):
        T = se3.compose(se3.inverse(T_base_s[k]), T_base_f)
        moves = drift * XI_UNITS * rng.normal(size=6)
        if rng.random() < slip_fraction:
            moves += np.array([1.0, 1.0, 0.0, 0.0, 0.0, 2.0]) * XI_UNITS * rng.normal(size=6)
        T_s_f[k] = se3.compose(se3.exp(moves), T)
        T_base_f = se3.project(T_base_s[k] @ T_s_f[k])
    sigma = np.broadcast_to(SYNTHETIC_SIGMA, (n, 6))
    scale = np.where(rng.random(n) < outlier_fraction, 6.0, 1.0)
    xi = se3.log(T_s_f) + sigma * scale[:, None] * rng.normal(size=(n, 6))
    predictions = [Prediction(mean, np.diag(each**2), in_range=True) for mean, each in zip(xi, sigma, strict=True)]
    return _sequence(T_base_s, T_s_f, predictions)


def single_frames(sequence: ContactSequence) -> Track:
    """Return the single frames' estimates, without a filter."""
    nees = [mahalanobis_squared(g, T) for g, T in zip(sequence.observed, sequence.T_s_f, strict=True)]
    return Track(contact_from_xi(sequence.xi), sequence.sigma, np.array(nees), np.empty(0))


def filtered(
    sequence: ContactSequence,
    level: float,
    make: Callable[[Array], PoseFilter] = PoseFilter,
    *,
    out_of_range_too: bool = False,
) -> Track:
    """Run a filter over the sequence.

    Args:
        sequence: contacts.
        level: standard deviation of the dynamics noise per contact, in mm and degrees.
        make: builds the filter from its noise density.
        out_of_range_too: fuse predictions outside the training range as well, unlike
            ``touchcell.perception.runtime.pipeline``.
    """
    pose_filter = make(np.diag((level * XI_UNITS) ** 2))
    states: list[FilterState] = []
    for k, (observation, T) in enumerate(zip(sequence.observed, sequence.T_base_s, strict=True)):
        if sequence.in_range[k] or out_of_range_too or not states:
            states.append(pose_filter.update(observation, T, k * STEP_NS))
        else:
            states.append(FilterState(pose_filter.predict(T, k * STEP_NS), T, k * STEP_NS))
    means = np.stack([state.belief.mean for state in states])
    inverses = se3.left_jacobian_inverse(se3.log(means))
    covariances = inverses @ np.stack([state.belief.covariance for state in states]) @ np.swapaxes(inverses, 1, 2)
    return Track(
        se3.to_euler_mm_deg(se3.inverse(means)),
        np.sqrt(np.diagonal(covariances, axis1=1, axis2=2)),
        np.array([mahalanobis_squared(s.belief, T) for s, T in zip(states, sequence.T_s_f, strict=True)]),
        np.array([state.nis for state in states if state.nis is not None]),
    )


def summary(sequences: list[ContactSequence], tracks: list[Track]) -> dict[str, Any]:
    """Return MAE and mean sigma per component, NEES and NIS with 95 % bounds, over sequences of one kind.

    Consecutive errors of a filter are correlated, so the bounds use the effective number of independent values.
    """
    truth = np.concatenate([se3.to_euler_mm_deg(se3.inverse(sequence.T_s_f)) for sequence in sequences])
    contact = np.concatenate([track.contact for track in tracks])
    sigma = np.concatenate([track.sigma for track in tracks]) / XI_UNITS
    mae = dict(zip(CONTACT_NAMES, np.abs(contact - truth).mean(axis=0).tolist(), strict=True))
    return {
        "mae": mae,
        "sigma": dict(zip(CONTACT_NAMES, sigma.mean(axis=0).tolist(), strict=True)),
        "nees": _consistency([track.nees for track in tracks]),
        "nis": _consistency([track.nis for track in tracks]) if len(tracks[0].nis) else None,
    }


def _consistency(series: list[Array]) -> dict[str, float]:
    values = np.concatenate(series)
    independent = sum(len(one) for one in series) / _correlation_length(series)
    # The mean of many chi-squared variables of 6 degrees of freedom, variance 12 each, is nearly normal.
    half = 1.96 * np.sqrt(12.0 / max(1.0, independent))
    return {
        "mean": float(values.mean()),
        "median": float(np.median(values)),
        "low": float(6.0 - half),
        "high": float(6.0 + half),
        "below_95": float((values <= 12.592).mean()),
    }


def _correlation_length(series: list[Array]) -> float:
    """Return 1 + 2 (r_1 + r_2 + ...) with r_k the correlation of values k apart, summed while it is positive."""
    centred = [one - np.mean(np.concatenate(series)) for one in series]
    variance = np.mean(np.concatenate(centred) ** 2)
    length = 1.0
    for k in range(1, min(len(one) for one in series) // 2):
        r = np.mean([np.mean(one[:-k] * one[k:]) for one in centred]) / variance
        if r <= 0.0:
            break
        length += 2.0 * float(r)
    return length


def _sequence(T_base_s: Array, T_s_f: Array, predictions: Sequence[Prediction]) -> ContactSequence:
    return ContactSequence(
        T_base_s,
        T_s_f,
        tuple(gaussian.from_exponential(one.xi, one.covariance) for one in predictions),
        np.stack([one.xi for one in predictions]),
        np.stack([one.sigma for one in predictions]),
        np.array([one.in_range for one in predictions]),
    )
