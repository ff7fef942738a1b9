"""Displacement networks of a marker model in NumPy, for batches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array
from touchcell.perception.models.marker_architecture import LOG_PRECISION_BOUNDS, MarkerArchitecture
from touchcell.perception.models.model_file import Labels, Model

Layers = list[tuple[NDArray[Any], NDArray[Any]]]
"""Weights (networks, before, units) and biases (networks, 1, units) of a model's networks, in order."""


def layers_of(model: Model) -> Layers:
    """Return the weights and biases of a marker model's networks."""
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    return [
        (model.tensors[f"layer{i}.weight"].astype(np.float64), model.tensors[f"layer{i}.bias"].astype(np.float64))
        for i in range(len(architecture.hidden) + 1)
    ]


def outputs_of(layers: Layers, displacements: NDArray[Any], labels: Labels) -> tuple[Array, Array]:
    """Return means (n, 6) in label half-ranges and uncalibrated sigmas of the mixture, of displacements (n, 2 m) px.

    The precision of the computation is that of the layers.
    """
    kind = layers[0][0].dtype
    x: NDArray[Any] = np.broadcast_to(displacements.astype(kind), (len(layers[0][0]), *displacements.shape))
    for i, (weight, bias) in enumerate(layers):
        x = x @ weight + bias
        if i + 1 < len(layers):
            x = x / (1.0 + np.exp(-np.maximum(x, kind.type(-80.0))))
    outputs = x.astype(np.float64)
    return mixed(outputs[..., :6], np.clip(outputs[..., 6:], *LOG_PRECISION_BOUNDS), labels)


def mixed(means: Array, log_precisions: Array, labels: Labels) -> tuple[Array, Array]:
    """Return mean and standard deviations of a mixture of Gaussians with equal weights.

    Args:
        means: (networks, ..., 6) in label half-ranges.
        log_precisions: (networks, ..., 6) logarithms of inverse standard deviations, along ``labels.aligned``.
        labels: of the model.

    Returns:
        (..., 6) and (..., 6).
    """
    mean: Array = means.sum(axis=0) / len(means)
    apart = labels.aligned(means - mean, mean)
    variance = (np.exp(-2.0 * log_precisions) + np.square(apart)).sum(axis=0) / len(means)
    return mean, np.sqrt(variance)
