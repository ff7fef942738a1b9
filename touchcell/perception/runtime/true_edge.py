"""The true edge under a sensor, with noise, in place of an estimate: to see control of edges apart from estimation."""

from __future__ import annotations

import zlib
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field, NonNegativeInt

from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec, Feature
from touchcell.perception.runtime.pipeline import ContactSource


class NoisyEdgeSource:
    """A ``ContactSource`` that reads the camera, but takes the edge from the scene at each frame's time, with noise.

    Args:
        camera: an opened frame source.
        truth: source of the true edge.
        sigma: (6,) standard deviations of the noise, m and rad, on the left of ``T_s_e``.
        seed: of the noise; frame k has the same noise whenever it is asked for.
    """

    ended = False

    def __init__(self, camera: FrameSource, truth: ContactSource, sigma: Array, seed: tuple[int, ...]) -> None:
        self._camera = camera
        self._truth = truth
        self._sigma = sigma
        self._covariance = np.diag(np.maximum(sigma, 1e-6) ** 2)
        self._seed = seed
        self._newest: ContactEstimate | None = None
        self.frame: Stamped[Frame] | None = None

    def await_frame(self) -> None:
        """Wait for the camera's first frame. Raises DeviceError."""
        self._camera.latest()

    def take_zero(self) -> bool:
        """Return False: images are not compared."""
        return False

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Pass the pose on."""
        self._truth.record_pose(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Return the edge at the newest frame. Raises DeviceError from the camera."""
        frame = self._camera.latest()
        if self.frame is not None and frame.seq == self.frame.seq:
            return self._newest
        self.frame = frame
        true = self._truth.update(frame.t_ns)
        if true is None or true.belief is None:
            self._newest = ContactEstimate(False, None, frame.t_ns, frame.seq, frame.t_ns)
        else:
            noise = np.random.default_rng((*self._seed, frame.seq)).normal(0.0, 1.0, 6) * self._sigma
            observed = PoseGaussian(se3.compose(se3.exp(noise), true.belief.mean), self._covariance)
            self._newest = ContactEstimate(True, observed, frame.t_ns, frame.seq, frame.t_ns)
        return self._newest


class TrueEdge(EstimatorConfig):
    """The edge under the tip from the simulated scene at each frame of the camera, with noise.

    Attributes:
        noise_mm: standard deviation of each component of the position.
        noise_deg: standard deviation of each component of the orientation.
        seed: of the noise.
    """

    needs_truth: ClassVar[bool] = True
    feature: ClassVar[Feature] = "edge"

    kind: Literal["true_edge"]
    noise_mm: float = Field(default=0.0, ge=0.0, le=5.0)
    noise_deg: float = Field(default=0.0, ge=0.0, le=20.0)
    seed: NonNegativeInt = 0

    def build(self, context: EstimatorContext) -> NoisyEdgeSource:
        """Return the source. Raises ConfigError where the edge is not known."""
        if context.true_edge is None:
            key = f"sensors.{context.sensor}.estimator.kind"
            raise ConfigError("the true edge is not known here", key=key, value=self.kind, hint="add a scene")
        sigma = np.repeat([1e-3 * self.noise_mm, np.radians(self.noise_deg)], 3)
        seed = (self.seed, zlib.crc32(context.sensor.encode()))
        return NoisyEdgeSource(context.camera, context.true_edge, sigma, seed)


TRUE_EDGE = EstimatorSpec("true_edge", "the simulator's own edge, with noise", TrueEdge)
