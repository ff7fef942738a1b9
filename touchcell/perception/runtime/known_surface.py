"""Contact from the poses of arm and surface: for collecting labels before a model exists."""

from __future__ import annotations

from typing import Literal

import numpy as np

from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec

# An arm repeats to about a tenth of a millimetre and of a degree.
_COVARIANCE = np.diag([1e-8] * 3 + [3e-6] * 3)


class KnownSurfaceSource:
    """A ``ContactSource`` that reads the camera, but computes the contact from the arm's pose.

    Slip is not observed: the contact is the commanded one, as in the public data.

    Args:
        camera: an opened frame source.
        T_base_f: (4, 4) surface frame in the arm's base: the sensor frame at first touch, upright.
    """

    ended = False

    def __init__(self, camera: FrameSource, T_base_f: Array) -> None:
        self._camera = camera
        self._T_base_f = T_base_f
        self._T_base_s: Array | None = None
        self.frame: Stamped[Frame] | None = None

    def await_frame(self) -> None:
        """Wait for the camera's first frame. Raises DeviceError."""
        self._camera.latest()

    def take_zero(self) -> bool:
        """Return False: it compares with no image."""
        return False

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Record the sensor's pose."""
        self._T_base_s = T_base_sensor

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Return the current contact, stamped with the newest frame. Raises DeviceError from the camera."""
        frame = self._camera.latest()
        if self.frame is None or frame.seq != self.frame.seq:
            self.frame = frame
        if self._T_base_s is None:
            return None
        T_s_f = se3.compose(se3.inverse(self._T_base_s), self._T_base_f)
        touches = bool(se3.inverse(T_s_f)[2, 3] > 0.0)
        return ContactEstimate(touches, PoseGaussian(T_s_f, _COVARIANCE), self.frame.t_ns, self.frame.seq, now_ns)


class KnownSurface(EstimatorConfig):
    """The contact from the arm's pose above a surface at a given pose, for collecting labels.

    ``surface_mm_deg`` is the pose of the sensor frame in the arm's base when it just touches the surface, upright.

    Attributes:
        surface_mm_deg: pose of the sensor frame in the arm's base when it just touches the surface, upright.
    """

    kind: Literal["known_surface"]
    surface_mm_deg: tuple[float, float, float, float, float, float]

    def build(self, context: EstimatorContext) -> KnownSurfaceSource:
        """Return the source."""
        return KnownSurfaceSource(context.camera, se3.from_euler_mm_deg(np.array(self.surface_mm_deg)))


KNOWN_SURFACE = EstimatorSpec("known_surface", "contact from the arm's pose above a known surface", KnownSurface)
