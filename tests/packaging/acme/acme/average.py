"""A filter: the running mean of the observed poses."""

from typing import Literal

from pydantic import Field

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.filter_spec import FilterConfig, FilterSpec, FilterState


class Average:
    """Moves a share of the way to each observation."""

    def __init__(self, share: float) -> None:
        self._share = share
        self._belief: PoseGaussian | None = None

    def reset(self) -> None:
        self._belief = None

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        assert self._belief is not None
        return self._belief

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        mean = observation.mean
        if self._belief is not None:
            way = se3.log(se3.compose(mean, se3.inverse(self._belief.mean)))
            mean = se3.compose(se3.exp(self._share * way), self._belief.mean)
        self._belief = PoseGaussian(mean, observation.covariance)
        return FilterState(self._belief, T_base_sensor, t_ns)


class AverageConfig(FilterConfig):
    """Keys of the filter."""

    model: Literal["acme_average"]
    share: float = Field(gt=0.0, le=1.0)

    def build(self) -> Average:
        return Average(self.share)


SPEC = FilterSpec("acme_average", "running mean of the observed poses", AverageConfig)
