"""Train a classifier of what a tip touches. Needs the extra ``train`` (PyTorch)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from touchcell.geometry.types import Array
from touchcell.perception.features.feature_model import CLASSES, FeatureModel

_COMPONENTS: Final = 80
_HIDDEN: Final = (96, 48)
_BATCH: Final = 128
_LEARNING_RATE: Final = 2e-3
_TEMPERATURES: Final = np.geomspace(0.5, 4.0, 61)


@dataclass(frozen=True)
class LabelledFields:
    """Marker fields with their classes.

    Attributes:
        displacements: (n, 2 m) px.
        classes: (n,) indices of ``CLASSES``.
    """

    displacements: Array
    classes: NDArray[np.int64]


def train_features(
    training: LabelledFields, validation: LabelledFields, *, epochs: int = 12, noise_px: float = 0.1, seed: int = 0
) -> FeatureModel:
    """Return a classifier that was trained by cross entropy, its temperature fitted to ``validation``.

    Args:
        training, validation: marker fields.
        epochs: passes over the training set.
        noise_px: added to each marker in training, as matching does.
        seed: of everything random.
    """
    mean = training.displacements.mean(axis=0)
    _, singular, basis = np.linalg.svd(training.displacements[:8000] - mean, full_matrices=False)
    spread = singular[:_COMPONENTS] / math.sqrt(min(len(training.displacements), 8000))
    whitened = basis[:_COMPONENTS].T / np.maximum(spread, noise_px)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = _network()
        _fit(network, training, mean, whitened, epochs, noise_px)
    linear = [layer for layer in network if isinstance(layer, nn.Linear)]
    weights = [layer.weight.detach().double().numpy().T for layer in linear]
    biases = [layer.bias.detach().double().numpy() for layer in linear]
    weights[0] = whitened @ weights[0]
    biases[0] = biases[0] - mean @ weights[0]
    model = FeatureModel(
        tuple(np.ascontiguousarray(weight, dtype=np.float32) for weight in weights),
        tuple(bias.astype(np.float32) for bias in biases),
        1.0,
    )
    return FeatureModel(model.weights, model.biases, _temperature(model, validation))


def _network() -> nn.Sequential:
    layers: list[nn.Module] = []
    before = _COMPONENTS
    for units in _HIDDEN:
        layers += [nn.Linear(before, units), nn.ReLU()]
        before = units
    return nn.Sequential(*layers, nn.Linear(before, len(CLASSES)))


def _fit(
    network: nn.Sequential, training: LabelledFields, mean: Array, whitened: Array, epochs: int, noise_px: float
) -> None:
    fields = torch.from_numpy((training.displacements - mean).astype(np.float32))
    classes = torch.from_numpy(training.classes)
    projection: Tensor = torch.from_numpy(whitened.astype(np.float32))
    batches = len(fields) // _BATCH
    optimizer = torch.optim.AdamW(network.parameters(), lr=_LEARNING_RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, _LEARNING_RATE, total_steps=epochs * batches)
    for _ in range(epochs):
        order = torch.randperm(len(fields))
        for i in range(batches):
            chosen = order[i * _BATCH : (i + 1) * _BATCH]
            noisy = fields[chosen] + noise_px * torch.randn(_BATCH, fields.shape[1])
            loss = functional.cross_entropy(network(noisy @ projection), classes[chosen])
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            schedule.step()


def _temperature(model: FeatureModel, validation: LabelledFields) -> float:
    logits = model.logits(validation.displacements)
    rows = np.arange(len(logits))

    def loss(temperature: float) -> float:
        scaled = logits / temperature
        scaled = scaled - scaled.max(axis=1, keepdims=True)
        return float((np.log(np.exp(scaled).sum(axis=1)) - scaled[rows, validation.classes]).mean())

    return float(min(_TEMPERATURES, key=loss))
