"""A classifier of what a tip touches, from the displacements of its markers, and its file.

A small dense network on the marker field that the contact estimator has already matched: some 40 us a frame. Its
probabilities are calibrated by one temperature on validation contacts (Guo et al., ICML 2017).
"""

from __future__ import annotations

import json
import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.errors import ModelError

CLASSES: Final = ("none", "surface", "edge", "corner")
"""What is told apart, in the order of the outputs. A corner is where an edge turns sharply, as at a point of a star."""

_METADATA_KEY: Final = "touchcell_features"
_FORMAT: Final = 1


@dataclass(frozen=True, slots=True)
class TouchedFeature:
    """Probabilities of what a tip touches; they add up to one."""

    none: float
    surface: float
    edge: float
    corner: float

    @property
    def likeliest(self) -> str:
        """Name of the most probable class."""
        return max(CLASSES, key=lambda name: float(getattr(self, name)))

    @property
    def along_an_edge(self) -> float:
        """Probability of an edge, its corners included."""
        return self.edge + self.corner


NOTHING: Final = TouchedFeature(1.0, 0.0, 0.0, 0.0)
"""Where the contact gate sees no contact."""


@dataclass(frozen=True)
class FeatureModel:
    """A trained classifier.

    Attributes:
        weights: of each layer, (inputs, units); the first takes displacements (2 m,) px of all markers.
        biases: (units,) of each layer.
        temperature: by which the outputs are divided before they become probabilities.
    """

    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    temperature: float

    @property
    def markers(self) -> int:
        """Number of markers of the sensor."""
        return len(self.weights[0]) // 2

    def logits(self, displacements: Array) -> Array:
        """Return (..., 4) of displacements (..., 2 m) px, before the temperature."""
        x = np.asarray(displacements, np.float32)
        for i, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            # ``einsum`` stays on its thread.
            x = np.einsum("...i,ij->...j", x, weight) + bias
            if i + 1 < len(self.weights):
                x = np.maximum(x, np.float32(0.0))
        return x.astype(np.float64)

    def probabilities(self, displacements: Array) -> Array:
        """Return (..., 4) probabilities of ``CLASSES`` of displacements (..., 2 m) px."""
        scaled = self.logits(displacements) / self.temperature
        raised = np.exp(scaled - scaled.max(axis=-1, keepdims=True))
        shares: Array = raised / raised.sum(axis=-1, keepdims=True)
        return shares

    def touched(self, displacements: Array) -> TouchedFeature:
        """Return what the displacements (m, 2) px of one frame show."""
        return TouchedFeature(*self.probabilities(displacements.ravel()).tolist())


def save_feature_model(model: FeatureModel, path: Path) -> None:
    """Write a classifier's file atomically."""
    from safetensors.numpy import save

    header = {"format_version": _FORMAT, "classes": CLASSES, "temperature": model.temperature}
    tensors: dict[str, NDArray[np.generic]] = {}
    for i, (weight, bias) in enumerate(zip(model.weights, model.biases, strict=True)):
        tensors[f"layer{i}.weight"], tensors[f"layer{i}.bias"] = weight, bias
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
        unfinished = Path(scratch) / path.name
        unfinished.write_bytes(save(tensors, metadata={_METADATA_KEY: json.dumps(header)}))
        os.replace(unfinished, path)


def load_feature_model(path: Path) -> FeatureModel:
    """Read a classifier's file.

    Raises:
        ModelError: the file is missing, damaged, no classifier, or of another format.
    """
    from safetensors import SafetensorError, safe_open

    hint = "`touchcell train-sim --feature kinds --out NAME.safetensors` writes one"
    if not path.is_file():
        raise ModelError(path, "no such file", hint=hint)
    try:
        with safe_open(path, framework="np") as stored:
            text = (stored.metadata() or {}).get(_METADATA_KEY)
            tensors = {name: stored.get_tensor(name) for name in stored.keys()}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise ModelError(path, f"damaged, or not a safetensors file: {error}", hint=hint) from error
    if text is None:
        raise ModelError(path, "a safetensors file, but no classifier of contact features", hint=hint)
    header = json.loads(text)
    if header.get("format_version") != _FORMAT or tuple(header.get("classes", ())) != CLASSES:
        raise ModelError(path, "of another format than this touchcell reads", key="format_version", hint=hint)
    layers = len(tensors) // 2
    names = [f"layer{i}" for i in range(layers)]
    if any(f"{name}.{part}" not in tensors for name in names for part in ("weight", "bias")):
        raise ModelError(path, "missing tensor", hint=hint)
    if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
        raise ModelError(path, "holds values that are not finite", hint=hint)
    return FeatureModel(
        tuple(tensors[f"{name}.weight"] for name in names),
        tuple(tensors[f"{name}.bias"] for name in names),
        float(header["temperature"]),
    )
