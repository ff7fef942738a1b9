"""A surface: a plane that rises along x."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from touchcell.geometry.surface_point import SurfacePoint
from touchcell.geometry.types import Array
from touchcell.simulation.shape_spec import SurfaceConfig, SurfaceSpec


@dataclass(frozen=True)
class Slope:
    rise_rad: float

    def nearest(self, p: Array) -> SurfacePoint:
        normal = np.array([-np.sin(self.rise_rad), 0.0, np.cos(self.rise_rad)])
        distance_m = float(normal @ p)
        return SurfacePoint(distance_m, normal, p - distance_m * normal)


class SlopeConfig(SurfaceConfig):
    """Keys of the surface."""

    kind: Literal["acme_slope"]
    rise_deg: float = Field(gt=-45.0, lt=45.0)

    def shape(self) -> Slope:
        return Slope(float(np.radians(self.rise_deg)))


SPEC = SurfaceSpec("acme_slope", "a plane that rises along x", SlopeConfig)
