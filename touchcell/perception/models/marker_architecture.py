"""Architecture of a marker model: the part of its file that defines the tensors."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.perception.models.architecture_spec import ArchitectureConfig

Count = Annotated[int, Field(gt=0)]
Number = Annotated[float, Field(allow_inf_nan=False)]

LOG_PRECISION_BOUNDS = (-3.0, 6.0)
"""Bounds of the logarithms of inverse standard deviations, in label half-ranges."""


CHECKED = 15
"""Functionals of a camera check: shift u, shift v, zoom, turn, then one for each of the lattice's eleven symmetries."""


class CameraCheckSpec(BaseModel):
    """Test of marker displacements for another camera and for torn images.

    The logarithm of the markers' root mean square from the principal components of real contacts, px, grows linearly
    with the strength of the contact, which is the Mahalanobis norm of the first modes.

    Attributes:
        components: number of principal components.
        misfit: intercept and slope of that line.
        most: largest accepted excess over it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    components: Count
    misfit: tuple[Number, Number]
    most: Number


class MarkerArchitecture(ArchitectureConfig):
    """Markers are detected and matched to a lattice, and their displacements are the input of several small networks.

    The estimate is mean and variance of the mixture of the networks' Gaussians.

    Attributes:
        kind: markers.
        input_size: (height, width) of the preprocessed, black and white image; markers keep their pixels.
        size: bounds on the white discs that are markers.
        rings: of the lattice, beside its centre; ring k holds 6k markers.
        modes: number of components of the displacement model.
        bank: number of stored contacts to start a match from.
        grid: cells along each side of the first guess's input.
        guess_low_px: (u, v) of the corner of that grid.
        guess_cell_px: side of its cells.
        guess_hidden: units of the first guess.
        least_score: matches below are not accepted.
        most_rms_px: matches with larger residuals are not accepted.
        hidden: units of the layers of each displacement network.
        networks: number of networks.
        camera_check: detects another camera and torn images (``markers.camera_check``); None for files without it.
    """

    reports_markers: ClassVar[bool] = True

    kind: Literal["markers"] = "markers"
    input_size: tuple[int, int]
    size: MarkerSize
    rings: Count = 10
    modes: Count = 24
    bank: Count
    grid: Count = 32
    guess_low_px: tuple[Number, Number]
    guess_cell_px: float = Field(gt=0.0, allow_inf_nan=False)
    guess_hidden: Count = 256
    least_score: float = Field(ge=0.0, le=1.0)
    most_rms_px: float = Field(gt=0.0, allow_inf_nan=False)
    hidden: Annotated[tuple[Count, ...], Field(min_length=1)] = (384, 512, 512, 256)
    networks: Count = 2
    camera_check: CameraCheckSpec | None = None

    @property
    def markers(self) -> int:
        """Number of markers in the lattice."""
        return 1 + 3 * self.rings * (self.rings + 1)

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the tensors of a model file."""
        m, k = self.markers, self.modes
        shapes: dict[str, tuple[int, ...]] = {
            "lattice": (m, 2),
            "displacement.mean": (2 * m,),
            "displacement.basis": (k, 2 * m),
            "displacement.sd": (k,),
            "bank": (self.bank, k),
            "guess.hidden.weight": (self.guess_hidden, self.grid**2),
            "guess.hidden.bias": (self.guess_hidden,),
            "guess.output.weight": (k, self.guess_hidden),
            "guess.output.bias": (k,),
            "guess.sd": (k,),
        }
        before = 2 * m
        for i, units in enumerate((*self.hidden, 12)):
            shapes[f"layer{i}.weight"] = (self.networks, before, units)
            shapes[f"layer{i}.bias"] = (self.networks, 1, units)
            before = units
        if self.camera_check:
            shapes["camera.mean"] = (2 * m,)
            shapes["camera.functionals"] = (CHECKED, 2 * m)
            shapes["camera.basis"] = (self.camera_check.components, 2 * m)
        return shapes


class MarkerSize(BaseModel):
    """Bounds on connected components that are markers.

    Attributes:
        smallest_px: smallest area. Halo speckle is smaller.
        largest_px: largest area. Reflections and markers that touch each other are larger.
        longest_side_px: of the bounding box.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    smallest_px: int = Field(gt=0)
    largest_px: int = Field(gt=0)
    longest_side_px: int = Field(gt=0)

    @model_validator(mode="after")
    def _ordered(self) -> MarkerSize:
        if self.largest_px <= self.smallest_px:
            raise ValueError("largest_px must exceed smallest_px")
        return self

    @classmethod
    def of_disc(cls, area_px: float) -> MarkerSize:
        """Return bounds for discs of about this area: half of it to not quite two."""
        diameter = 2.0 * np.sqrt(area_px / np.pi)
        return cls(
            smallest_px=max(1, int(0.45 * area_px)),
            largest_px=int(1.8 * area_px) + 1,
            longest_side_px=int(1.8 * diameter) + 1,
        )
