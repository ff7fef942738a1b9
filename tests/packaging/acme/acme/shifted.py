"""An estimator: the true contact, shifted along the sensor's axis and filtered."""

from typing import ClassVar, Literal

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext, EstimatorSpec
from touchcell.perception.runtime.filter_spec import ContactFilter, FilterSection
from touchcell.perception.runtime.pipeline import ContactSource


class Shifted(ContactSource):
    """The truth with an error, in place of camera and network."""

    def __init__(self, truth: ContactSource, shift_m: float, pose_filter: ContactFilter) -> None:
        self._truth, self._filter = truth, pose_filter
        self._T_shift = se3.exp([0.0, 0.0, shift_m, 0.0, 0.0, 0.0])
        self._T_base_sensor: Array = se3.exp([0.0] * 6)

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        self._T_base_sensor = T_base_sensor
        self._truth.record_pose(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        true = self._truth.update(now_ns)
        if true is None or true.belief is None:
            self._filter.reset()
            return true
        observed = PoseGaussian(se3.compose(true.belief.mean, self._T_shift), true.belief.covariance)
        belief = self._filter.update(observed, self._T_base_sensor, true.t_frame_ns).belief
        return ContactEstimate(True, belief, true.t_frame_ns, true.seq, true.t_ns)


class ShiftedConfig(EstimatorConfig):
    """Keys of the estimator."""

    needs_truth: ClassVar[bool] = True

    kind: Literal["acme_shifted"]
    shift_mm: float
    filter: FilterSection

    def build(self, context: EstimatorContext) -> ContactSource:
        assert context.truth is not None
        return Shifted(context.truth, 1e-3 * self.shift_mm, self.filter.build())


SPEC = EstimatorSpec("acme_shifted", "true contact with a shift", ShiftedConfig)
