"""Architecture of a contact network, independent of the training library: the tensors and graph of a model file."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from touchcell.perception.models.architecture_spec import ArchitectureConfig

Rate = Annotated[float, Field(ge=0.0, lt=1.0)]
SixRates = tuple[Rate, Rate, Rate, Rate, Rate, Rate]

MEAN_BOUNDS = (-3.0, 3.0)
"""Bounds of a Gaussian-density network's means, in label half-ranges. Labels lie in [-1, 1]; between these the bound is
nearly straight."""

LOG_PRECISION_BOUNDS = (-3.0, 7.0)
"""Bounds of the logarithms of its inverse standard deviations: sigma from 20 label half-ranges to a thousandth."""


CHECK = "check."
"""Prefix of the tensors of an image check."""

TERMS = 84
"""Monomials of six means up to the third degree."""


class ImageCheckSpec(BaseModel):
    """Limits of the check that an image's markers lie where the estimated contact moves them.

    Attributes:
        markers: how many the tip has.
        radius_px: distance up to which light belongs to a marker, px of the network's input.
        disc_px: radius of a marker, px of the network's input.
        least_level: mean grey level around the place of a marker that is seen.
        least_light: smallest accepted share of the image's light at markers, in units of their mean grey levels.
        modes: number of components of the field of the markers' distances from where they are expected.
        limits: largest accepted size of that field, in standard deviations, and roughness, px of the crop, then how
            much of each change of the camera it may show, in units of that change.
        changes: what each of these changes is.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)

    markers: int = Field(gt=1)
    radius_px: float = Field(gt=0.5, allow_inf_nan=False)
    disc_px: float = Field(gt=0.0, allow_inf_nan=False)
    least_level: float = Field(gt=0.0, allow_inf_nan=False)
    least_light: float = Field(ge=0.0, allow_inf_nan=False)
    modes: int = Field(gt=0)
    limits: Annotated[tuple[Annotated[float, Field(gt=0.0, allow_inf_nan=False)], ...], Field(min_length=2)]
    changes: tuple[str, ...]

    @model_validator(mode="after")
    def _limited(self) -> ImageCheckSpec:
        if len(self.limits) != 2 + len(self.changes):
            raise ValueError(f"{len(self.changes)} changes need {2 + len(self.changes)} limits")
        return self

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of its tensors, without their prefix."""
        wide = 2 * self.markers
        return {
            "rest": (self.markers, 2),
            "terms": (TERMS, wide),
            "mean": (wide,),
            "modes": (self.modes, wide),
            "sd": (self.modes,),
            "filters": (len(self.changes), wide),
        }


class Architecture(ArchitectureConfig):
    """Blocks of 3x3 convolution, 2x2 maximum, normalisation and ReLU, then a hidden layer and the outputs.

    Source: Lloyd & Lepora 2024, 3.1.4 (``cnn``: six means) and 3.1.5 (``gdn``: six means and six logarithms of inverse
    standard deviations, each with its own dropout, each bounded). The maximum is taken before the normalisation,
    which with positive scales is the same function for a third of the work.

    Attributes:
        kind: cnn, or gdn for a Gaussian density.
        input_size: (height, width) of the preprocessed image.
        channels: features of each block.
        hidden: units of the hidden layer.
        feature_dropout: rate before the hidden layer.
        mean_dropout: rate before each of the six means.
        precision_dropout: rate before each of the six inverse standard deviations (gdn).
        check: of images against the estimated contact; None for files without it.
    """

    kind: Literal["gdn", "cnn"] = "gdn"
    input_size: tuple[int, int] = (128, 128)
    channels: Annotated[tuple[Annotated[int, Field(gt=0)], ...], Field(min_length=1)] = (8, 16, 32, 64, 128)
    hidden: int = Field(default=256, gt=0)
    feature_dropout: Rate = 0.0
    mean_dropout: SixRates = (0.0,) * 6
    precision_dropout: SixRates = (0.0,) * 6
    check: ImageCheckSpec | None = None

    @model_validator(mode="after")
    def _features_remain(self) -> Architecture:
        if min(self.feature_size) < 1:
            raise ValueError(f"{len(self.channels)} halvings leave nothing of an image of {self.input_size}")
        return self

    @property
    def widest_sigma(self) -> float:
        """Largest standard deviation within the bounds, in label half-ranges; 1 for cnn, which reports none."""
        return math.exp(-LOG_PRECISION_BOUNDS[0]) if self.kind == "gdn" else 1.0

    @property
    def outputs(self) -> int:
        """Number of outputs: 6 means, and for gdn 6 logarithms of inverse standard deviations after them."""
        return 12 if self.kind == "gdn" else 6

    @property
    def feature_size(self) -> tuple[int, int]:
        """(height, width) of the features after the blocks."""
        return self.input_size[0] >> len(self.channels), self.input_size[1] >> len(self.channels)

    @property
    def bounds(self) -> tuple[list[float], list[float]] | None:
        """(low, high) of each output, or None for cnn, whose outputs are unbounded."""
        if self.kind == "cnn":
            return None
        (mean_low, mean_high), (log_low, log_high) = MEAN_BOUNDS, LOG_PRECISION_BOUNDS
        return [mean_low] * 6 + [log_low] * 6, [mean_high] * 6 + [log_high] * 6

    def tensor_shapes(self) -> dict[str, tuple[int, ...]]:
        """Return names and shapes of the tensors of a model file, normalisation folded into the convolutions."""
        shapes: dict[str, tuple[int, ...]] = {}
        before = 1
        for i, features in enumerate(self.channels):
            shapes[f"conv{i}.weight"] = (features, before, 3, 3)
            shapes[f"conv{i}.bias"] = (features,)
            before = features
        height, width = self.feature_size
        shapes["hidden.weight"] = (self.hidden, before * height * width)
        shapes["hidden.bias"] = (self.hidden,)
        shapes["output.weight"] = (self.outputs, self.hidden)
        shapes["output.bias"] = (self.outputs,)
        if self.check is not None:
            shapes |= {f"{CHECK}{name}": shape for name, shape in self.check.tensor_shapes().items()}
        return shapes
