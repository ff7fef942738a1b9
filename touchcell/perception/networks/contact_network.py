"""The networks of ``Architecture`` in PyTorch, for training. Never imported at run time."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.model_file import Labels


def softbound(x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """Return ``low + softplus(x - low) - softplus(x - high)``: x well inside the bounds, never beyond them.

    The three terms cancel for large x, in float32 to values outside the bounds and for infinities to NaN. The same
    function as one logarithm, ``low + log(1 + (1 - c) / (exp(low - x) + c))`` with ``c = exp(low - high)``, does not
    cancel: for every x, infinite ones too, the result lies in [low, high], rises with x, and has a finite gradient.
    Requires ``high - low`` below 80. Source: Lloyd & Lepora 2024, 3.1.5.
    """
    low, high = torch.as_tensor(low, dtype=x.dtype), torch.as_tensor(high, dtype=x.dtype)
    # Beyond 40 the function is flat to 1e-17, and an unlimited exponential would make the gradient 0 * inf.
    x = torch.minimum(torch.maximum(x, low - 40.0), high + 40.0)
    c = torch.exp(low - high)
    bounded = low + torch.log1p((1.0 - c) / (torch.exp(low - x) + c))
    return torch.minimum(torch.maximum(bounded, low), high)


class ContactNetwork(nn.Module):
    """Map images (n, 1, height, width) in [0, 1] to outputs (n, 6 or 12), as ``Architecture`` defines.

    Outputs are in label half-ranges about the label centres; see ``model_file.Labels``.
    """

    rates: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, architecture: Architecture) -> None:
        super().__init__()
        self.architecture = architecture
        self.convolutions = nn.ModuleList()
        self.normalisations = nn.ModuleList()
        before = 1
        for features in architecture.channels:
            self.convolutions.append(nn.Conv2d(before, features, 3, padding=1, bias=False))
            normalisation = nn.BatchNorm2d(features)
            # A scale before ReLU and a convolution is redundant, and fixed at one it cannot turn a maximum into a
            # minimum, so the normalisation folds into the convolution before the pooling.
            normalisation.weight.requires_grad_(False)
            self.normalisations.append(normalisation)
            before = features
        height, width = architecture.feature_size
        self.hidden = nn.Linear(before * height * width, architecture.hidden)
        self.output = nn.Linear(architecture.hidden, architecture.outputs)
        rates: tuple[float, ...] = architecture.mean_dropout
        if architecture.kind == "gdn":
            rates = (*rates, *architecture.precision_dropout)
            with torch.no_grad():
                self.output.weight[6:] *= 0.1
                self.output.bias[6:] = 0.0
        self.register_buffer("rates", torch.tensor(rates), persistent=False)
        low, high = architecture.bounds or ([], [])
        self.register_buffer("low", torch.tensor(low), persistent=False)
        self.register_buffer("high", torch.tensor(high), persistent=False)

    def forward(self, images: Tensor) -> Tensor:
        x = images
        for convolution, normalisation in zip(self.convolutions, self.normalisations, strict=True):
            x = functional.relu(normalisation(functional.max_pool2d(convolution(x), 2)))
        x = functional.dropout(x.flatten(1), self.architecture.feature_dropout, self.training)
        x = functional.relu(self.hidden(x))
        x = self._each_output_behind_its_own_dropout(x) if self.training and self.rates.any() else self.output(x)
        return softbound(x, self.low, self.high) if self.architecture.kind == "gdn" else x

    def folded(self) -> dict[str, NDArray[np.float32]]:
        """Return the tensors of a model file (``Architecture.tensor_shapes``), with the normalisation folded in."""
        tensors: dict[str, Tensor] = {}
        for i, (convolution, normalisation) in enumerate(zip(self.convolutions, self.normalisations, strict=True)):
            assert isinstance(convolution, nn.Conv2d)
            assert isinstance(normalisation, nn.BatchNorm2d)
            assert normalisation.running_mean is not None
            assert normalisation.running_var is not None
            gain = torch.rsqrt(normalisation.running_var.double() + normalisation.eps)
            tensors[f"conv{i}.weight"] = convolution.weight.double() * gain[:, None, None, None]
            tensors[f"conv{i}.bias"] = normalisation.bias.double() - normalisation.running_mean.double() * gain
        for name in ("hidden", "output"):
            layer = getattr(self, name)
            tensors[f"{name}.weight"], tensors[f"{name}.bias"] = layer.weight, layer.bias
        return {
            name: np.ascontiguousarray(tensor.detach().float().contiguous().numpy()) for name, tensor in tensors.items()
        }

    def _each_output_behind_its_own_dropout(self, features: Tensor) -> Tensor:
        keep = 1.0 - self.rates[:, None]
        mask = torch.bernoulli(keep.expand(len(features), -1, features.shape[1])) / keep
        return torch.einsum("noh,oh->no", features[:, None, :] * mask, self.output.weight) + self.output.bias


class Alignment:
    """``Labels.aligned`` in PyTorch: residuals along and across the predicted shear, instead of in x and y.

    The direction is detached from the gradient; otherwise a network could reduce its loss by rotating the shear of
    contacts that it cannot locate.
    """

    def __init__(self, labels: Labels) -> None:
        self._are_contacts = labels.are_contacts
        self._centre, self._half_range, self._scale = (
            torch.from_numpy(array.astype(np.float32))
            for array in (labels.centre[:2], labels.half_range[:2], labels.half_range[:2] / labels.sigma_unit[:2])
        )

    def __call__(self, residual: Tensor, mean: Tensor) -> Tensor:
        """Return residuals (..., 6) about outputs ``mean`` (..., 6), aligned."""
        if not self._are_contacts:
            return residual
        along = functional.normalize((self._centre + self._half_range * mean[..., :2]).detach(), dim=-1)
        shear = residual[..., :2] * self._scale
        across = shear[..., 1] * along[..., 0] - shear[..., 0] * along[..., 1]
        return torch.cat([(shear * along).sum(-1, keepdim=True), across[..., None], residual[..., 2:]], dim=-1)


def gaussian_loss(outputs: Tensor, labels: Tensor, alignment: Alignment) -> Tensor:
    """Return the mean negative log-likelihood, nats, of labels (n, 6) under gdn outputs (n, 12).

    Components are summed.
    """
    mean, log_precision = outputs[:, :6], outputs[:, 6:]
    residual = alignment(labels - mean, mean) * torch.exp(log_precision)
    return (0.5 * residual.square() - log_precision).sum(1).mean() + 3.0 * float(np.log(2.0 * np.pi))


def weighted_square_loss(outputs: Tensor, labels: Tensor, weights: Tensor) -> Tensor:
    """Return the mean over images of the weighted sum of squared errors of the six means."""
    return (weights * (outputs[:, :6] - labels).square()).sum(1).mean()


def weighted_absolute_loss(outputs: Tensor, labels: Tensor, weights: Tensor) -> Tensor:
    """Return the mean over images of the weighted sum of absolute errors of the six means."""
    return (weights * (outputs[:, :6] - labels).abs()).sum(1).mean()
