"""The displacement networks in PyTorch, for training. Never imported at run time."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from touchcell.geometry.types import Array
from touchcell.perception.markers.matching import DisplacementModel
from touchcell.perception.models.marker_architecture import LOG_PRECISION_BOUNDS
from touchcell.perception.networks.contact_network import Alignment

_DISPLACEMENT_PX = 8.0
_NARROWEST = 0.02


class DisplacementNetwork(nn.Module):
    """Map marker displacements (networks, n, 2 m) px to outputs (networks, n, 18), in label half-ranges.

    Outputs are six means, the logarithms of their inverse Laplace scales, which only the training uses, and the
    logarithms of their inverse standard deviations. Each network has the displacements and, with equal weight, the
    displacement model's coefficients as input: the modes of small variance carry tilt and depth.

    Args:
        model: of the displacements.
        hidden: units of each layer.
        networks: number of networks, trained side by side and independently.
        details: (k, 2 m) 1/px, rows that map displacements to further inputs (``details_of``); None for none.
    """

    mean: Tensor
    scaled: Tensor

    def __init__(
        self, model: DisplacementModel, hidden: tuple[int, ...], networks: int, details: Array | None = None
    ) -> None:
        super().__init__()
        features = features_of(model)
        if details is not None:
            features = np.concatenate([features, details.T], axis=1)
        scaled = features[:, len(model.mean) :]
        self.register_buffer("mean", torch.from_numpy(model.mean.astype(np.float32)), persistent=False)
        self.register_buffer("scaled", torch.from_numpy(scaled.astype(np.float32)), persistent=False)
        self.weights = nn.ParameterList()
        self.biases = nn.ParameterList()
        before = features.shape[1]
        for units in (*hidden, 18):
            bound = 1.0 / math.sqrt(before)
            self.weights.append(nn.Parameter(torch.empty(networks, before, units).uniform_(-bound, bound)))
            self.biases.append(nn.Parameter(torch.empty(networks, 1, units).uniform_(-bound, bound)))
            before = units
        with torch.no_grad():
            self.weights[-1][:, :, 6:] *= 0.1

    def forward(self, displacements: Tensor, noise: float = 0.0) -> Tensor:
        moved = displacements - self.mean
        x = torch.cat([moved / _DISPLACEMENT_PX, moved @ self.scaled], dim=-1)
        if noise:
            x = x + noise * torch.randn_like(x)
        for weight, bias in zip(list(self.weights)[:-1], list(self.biases)[:-1], strict=True):
            x = functional.silu(torch.baddbmm(bias, x, weight))
        # The standard deviations use the features of the means, detached, so that they do not change them.
        weight, bias = self.weights[-1], self.biases[-1]
        outputs = torch.baddbmm(bias[:, :, :12], x, weight[:, :, :12])
        spread = torch.baddbmm(bias[:, :, 12:], x.detach(), weight[:, :, 12:])
        low, high = LOG_PRECISION_BOUNDS
        return torch.cat([outputs[..., :6], outputs[..., 6:].clamp(low, high), spread.clamp(low, high)], dim=-1)

    def folded(self) -> dict[str, NDArray[np.float32]]:
        """Return the tensors of a model file: the first layer takes pixels, the last means and standard deviations."""
        weights = [weight.detach().double() for weight in self.weights]
        biases = [bias.detach().double() for bias in self.biases]
        m = len(self.mean)
        weights[0] = weights[0][:, :m] / _DISPLACEMENT_PX + self.scaled.double() @ weights[0][:, m:]
        biases[0] = biases[0] - (self.mean.double() @ weights[0])[:, None]
        kept = [*range(6), *range(12, 18)]
        weights[-1], biases[-1] = weights[-1][:, :, kept], biases[-1][:, :, kept]
        tensors: dict[str, NDArray[np.float32]] = {}
        for i, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            tensors[f"layer{i}.weight"] = np.ascontiguousarray(weight.float().numpy())
            tensors[f"layer{i}.bias"] = np.ascontiguousarray(bias.float().numpy().reshape(len(bias), 1, -1))
        return tensors


def features_of(model: DisplacementModel) -> Array:
    """Return the (2 m, f) inputs of the first layers: single markers, and the modes of the displacement model."""
    scaled = model.basis.T / np.maximum(model.sd, _NARROWEST * model.sd[0])
    return np.concatenate([np.eye(len(model.mean)) / _DISPLACEMENT_PX, scaled], axis=1)


def details_of(displacements: Array, count: int, smallest_px: float) -> Array:
    """Return (count, 2 m) 1/px: principal components, each scaled to a standard deviation of one.

    What tells an edge from one that leans moves markers by a tenth of a pixel, in components far behind those that
    suffice to match them.

    Args:
        displacements: (n, 2 m) px of training contacts.
        count: number of components.
        smallest_px: components that vary by less are scaled as if they varied by this.
    """
    centred = displacements - displacements.mean(axis=0)
    _, singular, basis = np.linalg.svd(centred, full_matrices=False)
    spread = singular[:count] / math.sqrt(len(centred))
    rows: Array = basis[:count] / np.maximum(spread, smallest_px)[:, None]
    return rows


class Jitter:
    """Augment displacements as by small shifts, rotations and zooms of the camera.

    Args:
        reference: (m, 2) px, the markers at rest.
        shift_px, turn_rad, zoom: standard deviations.
        marker_px: of each marker by itself.
    """

    def __init__(self, reference: Array, shift_px: float, turn_rad: float, zoom: float, marker_px: float = 0.0) -> None:
        self._around_middle = torch.from_numpy((reference - reference.mean(axis=0)).astype(np.float32))
        self._shift_px, self._turn_rad, self._zoom, self._marker_px = shift_px, turn_rad, zoom, marker_px

    def __call__(self, displacements: Tensor) -> Tensor:
        """Return displacements (networks, n, 2 m) px, each with another random camera change."""
        networks, n, _ = displacements.shape
        place = self._around_middle + displacements.view(networks, n, -1, 2)
        across = torch.stack([-place[..., 1], place[..., 0]], dim=-1)
        moved = self._shift_px * torch.randn(networks, n, 1, 2)
        moved = moved + self._turn_rad * torch.randn(networks, n, 1, 1) * across
        moved = moved + self._zoom * torch.randn(networks, n, 1, 1) * place
        if self._marker_px:
            moved = moved + self._marker_px * torch.randn_like(moved)
        return displacements + moved.flatten(2)


def displacement_loss(outputs: Tensor, labels: Tensor, alignment: Alignment) -> Tensor:
    """Laplace likelihood of the means, weighted, plus Gaussian likelihood of the standard deviations about those means.

    Slip causes heavy tails, for which a Laplace density is closer than a Gaussian. Each term is weighted by the root of
    its own scale (Seitzer et al. 2022, beta-NLL with beta 0.5), so that components that are hard to predict, gamma
    above all, are not neglected.

    Args:
        outputs: (networks, n, 18).
        labels: (networks, n, 6).
        alignment: of the standard deviations.
    """
    mean, log_inverse_scale, log_precision = outputs[..., :6], outputs[..., 6:12], outputs[..., 12:]
    residual = labels - mean
    off = residual.abs()
    laplace = (off * log_inverse_scale.exp() - log_inverse_scale) * (-0.5 * log_inverse_scale.detach()).exp()
    gaussian = 0.5 * (alignment(residual.detach(), mean) * log_precision.exp()).square() - log_precision
    loss: Tensor = (laplace.sum(-1) + 0.2 * gaussian.sum(-1)).mean()
    return loss
