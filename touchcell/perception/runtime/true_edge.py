"""The true edge under a sensor, with noise, in place of an estimate: to see control of edges apart from estimation."""

from __future__ import annotations

import zlib
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec, Feature
from touchcell.perception.runtime.pipeline import ContactSource


class NoisyEdgeSource(ContactSource):
    """A ``ContactSource`` that samples the true edge as a camera would, and adds noise to each sample.

    Args:
        truth: source of the true edge.
        sigma: (6,) standard deviations of the noise, m and rad, on the left of ``T_s_e``.
        period_ns: time from sample to sample.
        latency_ns: time from a sample to its delivery.
        seed: of the noise; sample k has the same noise whenever it is asked for.
    """

    def __init__(
        self, truth: ContactSource, sigma: Array, period_ns: int, latency_ns: int, seed: tuple[int, ...]
    ) -> None:
        self._truth = truth
        self._sigma = sigma
        self._covariance = np.diag(np.maximum(sigma, 1e-6) ** 2)
        self._period_ns, self._latency_ns = period_ns, latency_ns
        self._seed = seed
        self._first_ns: int | None = None
        self._newest: ContactEstimate | None = None

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Pass the pose on."""
        self._truth.record_pose(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Return the newest sample."""
        if self._first_ns is None:
            self._first_ns = now_ns
        seq = (now_ns - self._latency_ns) // self._period_ns
        if self._newest is not None and self._newest.seq == seq:
            return self._newest
        # Before a whole period has passed the first sample is of the beginning.
        t_ns = max(seq * self._period_ns, self._first_ns)
        true = self._truth.update(t_ns)
        if true is None or true.belief is None:
            self._newest = ContactEstimate(False, None, t_ns, seq, t_ns)
        else:
            noise = np.random.default_rng((*self._seed, abs(seq))).normal(0.0, 1.0, 6) * self._sigma
            observed = PoseGaussian(se3.compose(se3.exp(noise), true.belief.mean), self._covariance)
            self._newest = ContactEstimate(True, observed, t_ns, seq, t_ns)
        return self._newest


class TrueEdge(EstimatorConfig):
    """The edge under the tip from the simulated scene, with noise.

    Attributes:
        noise_mm: standard deviation of each component of the position.
        noise_deg: standard deviation of each component of the orientation.
        rate_hz: samples per second.
        latency_ms: time from a sample to its delivery.
        seed: of the noise.
    """

    needs_truth: ClassVar[bool] = True
    feature: ClassVar[Feature] = "edge"

    kind: Literal["true_edge"]
    noise_mm: float = Field(default=0.0, ge=0.0, le=5.0)
    noise_deg: float = Field(default=0.0, ge=0.0, le=20.0)
    rate_hz: float = Field(default=30.0, gt=0.0, le=1000.0)
    latency_ms: float = Field(default=10.0, ge=0.0, le=1000.0)
    seed: int = 0

    def build(self, context: EstimatorContext) -> NoisyEdgeSource:
        """Return the source. Raises ConfigError where the edge is not known."""
        if context.true_edge is None:
            key = f"sensors.{context.sensor}.estimator.kind"
            raise ConfigError("the true edge is not known here", key=key, value=self.kind, hint="add a scene")
        sigma = np.repeat([1e-3 * self.noise_mm, np.radians(self.noise_deg)], 3)
        seed = (self.seed, zlib.crc32(context.sensor.encode()))
        return NoisyEdgeSource(context.true_edge, sigma, round(1e9 / self.rate_hz), round(1e6 * self.latency_ms), seed)


TRUE_EDGE = EstimatorSpec("true_edge", "the simulator's own edge, with noise", TrueEdge)
