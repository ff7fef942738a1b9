"""Train the check of an image network: a small network that knows its own sensor's images from anything else.

It learns from the training images and from what is made of them: torn, rolled, zoomed, shifted and turned images, other
lattices, noise, checkers, covered halves. A jitter as between sessions, missing pins and dust stay accepted. Whether a
camera that is turned by a multiple of 60 degrees or mirrored can be told from an upright one depends on how regular
the pins are: a second output is trained for that, and used where it is right on images that were set aside.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional

from touchcell.geometry.types import ImageArray
from touchcell.perception.models.architecture import CHECK, ImageCheckSpec, shrunk
from touchcell.perception.models.preprocessing import scale
from touchcell.perception.networks.contact_network import ContactNetwork

STEPS = 1000
LEAST_IMAGES = 200
_LEAST_SIDE_PX = 50
_BATCH = 48
_LEARNING_RATE = 3e-3
_SET_ASIDE = 400
_REJECTED = 0.002
_MOST_ODDS = -1.0
_MARGIN = 0.2
_MARKERS_ACROSS = 21.0
_UPRIGHT_SHARE = 0.98


def train_check(
    images: ImageArray,
    input_size: tuple[int, int],
    *,
    upright: bool = True,
    steps: int = STEPS,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[ImageCheckSpec, dict[str, NDArray[np.float32]]]:
    """Return the check of an image network and its tensors.

    Args:
        images: uint8 (n, height, width), preprocessed, of the sensor's contacts.
        input_size: (height, width).
        upright: try to tell turned and mirrored cameras; False for a sensor that is known to be regular.
        steps: of the training, 48 images each.
        seed: of everything random.
        progress: called with the steps done and their number.
    """
    spec = ImageCheckSpec(least=0.0, shrink=max(1, min(input_size) // _LEAST_SIDE_PX))
    images = np.concatenate(
        [
            np.rint(255.0 * shrunk(scale(part), spec.shrink)).astype(np.uint8)
            for part in np.array_split(images, max(1, len(images) // 256))
        ]
    )
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(images))
    aside = images[order[: min(_SET_ASIDE, max(1, len(images) // 10))]]
    taught = images[order[len(aside) :]] if len(images) > 1 else images
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = ContactNetwork(spec.architecture(input_size))
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        optimizer = torch.optim.AdamW(network.parameters(), lr=_LEARNING_RATE, weight_decay=0.01)
        for step in range(steps):
            for group in optimizer.param_groups:
                group["lr"] = _LEARNING_RATE * min(1.0, (step + 1) / 50) * 0.5 * (1 + math.cos(math.pi * step / steps))
            batch = taught[rng.integers(0, len(taught), _BATCH)]
            inputs, own, straight, weighed = _examples(batch, rng, upright=upright)
            outputs = network(inputs.contiguous(memory_format=torch.channels_last))[:, :2]
            loss = functional.binary_cross_entropy_with_logits(outputs[:, 0], own)
            if upright:
                each = functional.binary_cross_entropy_with_logits(outputs[:, 1], straight, reduction="none")
                loss = loss + (each * weighed).sum() / weighed.sum().clamp(min=1.0)
            optimizer.zero_grad(set_to_none=True)
            loss.backward()  # type: ignore[no-untyped-call]
            optimizer.step()
            if progress is not None:
                progress(step + 1, steps)
        network.eval()
        with torch.inference_mode():
            kept = network(_exposed(_worn(_kept(_scaled(aside), rng), rng), rng)).numpy()[:, :2]
            turned = network(_exposed(_worn(_symmetric(_scaled(aside), rng), rng), rng)).numpy()[:, 1]
    least = min(_MOST_ODDS, float(np.quantile(kept[:, 0], _REJECTED)) - _MARGIN)
    # Where both classes look the same, the odds do not separate them.
    limit = min(_MOST_ODDS, float(np.quantile(kept[:, 1], _REJECTED)))
    knows = upright and float((turned < limit).mean()) > _UPRIGHT_SHARE
    spec = spec.model_copy(update={"least": least, "least_upright": limit if knows else None})
    return spec, {f"{CHECK}{name}": each for name, each in network.folded().items()}


def _scaled(images: ImageArray) -> Tensor:
    return torch.from_numpy(scale(images)).unsqueeze(1)


def _examples(batch: ImageArray, rng: np.random.Generator, *, upright: bool) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return inputs (n, 1, h, w), whether they are the sensor's own, upright, and which count for the latter."""
    images = _scaled(batch)
    n = len(images)
    parts = [0.36, 0.12, 0.18, 0.25, 0.09] if upright else [0.46, 0.0, 0.19, 0.26, 0.09]
    ends = np.cumsum(np.round(n * np.array(parts))).astype(int)[:-1]
    plain, turned, moved, cut, alien = (part for part in torch.tensor_split(images, ends.tolist()))
    inputs = torch.cat(
        [
            _kept(plain, rng),
            _symmetric(turned, rng),
            _moved(moved, rng),
            _cut(cut, images, rng),
            _alien(alien, rng),
        ]
    )
    own = torch.zeros(n)
    own[: len(plain) + len(turned)] = 1.0
    straight = torch.zeros(n)
    straight[: len(plain)] = 1.0
    weighed = torch.zeros(n)
    weighed[: len(plain) + len(turned)] = 1.0
    return _exposed(_worn(inputs, rng), rng), own, straight, weighed


def _warp(
    images: Tensor,
    zoom: NDArray[Any],
    turn_rad: NDArray[Any],
    shift: NDArray[Any],
    mirrored: NDArray[np.bool_] | None = None,
) -> Tensor:
    """Warp images about their centre; ``shift`` (n, 2) in image widths and heights. Outside is black."""
    n, _, height, width = images.shape
    motion = torch.zeros(n, 2, 3)
    cosine, sine = np.cos(turn_rad) / zoom, np.sin(turn_rad) / zoom
    flip = np.ones(n) if mirrored is None else np.where(mirrored, -1.0, 1.0)
    motion[:, 0, 0] = torch.from_numpy(flip * cosine)
    motion[:, 0, 1] = torch.from_numpy(-flip * sine * height / width)
    motion[:, 1, 0] = torch.from_numpy(sine * width / height)
    motion[:, 1, 1] = torch.from_numpy(cosine)
    motion[:, :, 2] = torch.from_numpy(2.0 * shift)
    grid = functional.affine_grid(motion, list(images.shape), align_corners=False)
    return functional.grid_sample(images, grid, mode="bicubic", align_corners=False).clamp(0.0, 1.0)


def _kept(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Jitter as between sessions; a third is as it is."""
    n = len(images)
    jittered = _warp(images, 1.0 + rng.normal(0, 0.004, n), rng.normal(0, 0.005, n), rng.normal(0, 0.0025, (n, 2)))
    which = torch.from_numpy(rng.random(n) < 0.67)[:, None, None, None]
    return torch.where(which, jittered, images)


def _worn(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Hide pins and add dust, as wear does. It happens to images of either class, and must not tell them apart."""
    out = images.clone()
    n, _, height, width = images.shape
    v, u = np.mgrid[:height, :width]
    pin = 0.45 * width / _MARKERS_ACROSS
    covered = np.zeros((n, 1, height, width), np.float32)
    for i in range(n):
        if rng.random() < 0.5:
            lost = int(rng.uniform(0.0, 0.22) * _MARKERS_ACROSS**2 * 0.78)
            spots = np.zeros((height, width), np.float32)
            spots[rng.integers(0, height, lost), rng.integers(0, width, lost)] = 1.0
            covered[i, 0] = spots
    reach = max(1, round(pin))
    hidden = functional.max_pool2d(torch.from_numpy(covered), 2 * reach + 1, stride=1, padding=reach)
    out = out * (1.0 - hidden)
    for spot in np.flatnonzero(rng.random(n) < 0.3):
        cu, cv, radius = rng.uniform(0.2, 0.8) * width, rng.uniform(0.2, 0.8) * height, rng.uniform(0.02, 0.07) * width
        out[spot, 0][torch.from_numpy((u - cu) ** 2 + (v - cv) ** 2 < radius**2)] = float(rng.random() < 0.2)
    return out


def _exposed(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Change brightness, sharpness and noise, as focus, light and threshold do."""
    n = len(images)
    gain, blur = (
        torch.from_numpy(rng.uniform(low, high, (n, 1, 1, 1)).astype(np.float32))
        for low, high in ((0.75, 1.2), (-0.4, 0.6))
    )
    smooth = functional.avg_pool2d(images, 3, stride=1, padding=1, count_include_pad=False)
    noise = torch.from_numpy(rng.normal(0, rng.uniform(0, 0.05, (n, 1, 1, 1)), images.shape).astype(np.float32))
    return (gain * (images + blur * (smooth - images)) + noise).clamp(0.0, 1.0)


def _symmetric(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Turn by a multiple of 60 degrees, or mirror."""
    n = len(images)
    sixths = rng.integers(1, 12, n)
    jitter = rng.normal(0, 0.002, (n, 2))
    return _warp(images, np.ones(n), np.pi / 3 * (sixths % 6), jitter, mirrored=sixths >= 6)


def _moved(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Zoom, shift or turn further than a session does, most of them by little."""
    n = len(images)
    kind = rng.integers(0, 4, n)
    sign = rng.choice([-1.0, 1.0], n)
    zoom = np.where((kind == 0) | (kind == 3), np.exp(sign * rng.exponential(0.05, n) + 0.035 * sign), 1.0)
    turn = np.where((kind == 1) | (kind == 3), sign * np.radians(3.5 + rng.exponential(5.0, n)), 0.0)
    angle = rng.uniform(0, 2 * np.pi, n)
    size = np.where((kind == 2) | (kind == 3), 0.017 + rng.exponential(0.02, n), 0.0)
    return _warp(images, zoom, turn, size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]))


def _cut(images: Tensor, others: Tensor, rng: np.random.Generator) -> Tensor:
    """Replace a part by that of another image, roll it, or cover it."""
    out = images.clone()
    _, _, height, width = images.shape
    for i in range(len(images)):
        edge, where = int(rng.integers(4)), rng.uniform(0.3, 0.7)
        rows, columns = int(where * height), int(where * width)
        everything = slice(None)
        part: tuple[slice, slice] = (
            (slice(0, rows), everything),
            (slice(rows, None), everything),
            (everything, slice(0, columns)),
            (everything, slice(columns, None)),
        )[edge]
        choice = rng.random()
        if choice < 0.62:
            out[i, 0][part] = others[rng.integers(len(others)), 0][part]
        elif choice < 0.72:
            out[i, 0][part] = torch.roll(images[i, 0][part], int(rng.integers(4, max(5, width // 3))), 1)
        elif choice < 0.78:
            out[i, 0] = torch.roll(images[i, 0], int(rng.integers(6, width - 6)), 1)
        else:
            out[i, 0][part] = float(rng.choice([0.0, 0.0, 0.5, 1.0]))
    return out


def _alien(images: Tensor, rng: np.random.Generator) -> Tensor:
    """Replace by images of something else: other lattices, noise, checkers, constants, the inverted image."""
    out = images.clone()
    _, _, height, width = images.shape
    v, u = np.mgrid[:height, :width].astype(np.float32)
    for i in range(len(images)):
        choice = rng.random()
        if choice < 0.6:
            spacing = width / rng.uniform(10.0, 32.0)
            shear = rng.choice([0.0, 0.5])
            turn = rng.uniform(0, np.pi)
            x = (np.cos(turn) * (u - width / 2) + np.sin(turn) * (v - height / 2)) / spacing + rng.random()
            y = (np.cos(turn) * (v - height / 2) - np.sin(turn) * (u - width / 2)) / spacing + rng.random()
            y = y / (np.sqrt(0.75) if shear else 1.0)
            row = np.round(y)
            dx = x - shear * row
            dx = dx - np.round(dx)
            away = np.hypot(dx, (y - row) * (np.sqrt(0.75) if shear else 1.0)) * spacing
            dots = np.clip(rng.uniform(0.2, 0.4) * spacing - away + 0.5, 0.0, 1.0)
            if rng.random() < 0.6:
                dots = dots * (np.hypot(u - width / 2, v - height / 2) < 0.47 * height)
            out[i, 0] = torch.from_numpy(dots.astype(np.float32))
        elif choice < 0.75:
            coarse = int(rng.integers(1, 4))
            grain = rng.random((height // coarse + 1, width // coarse + 1)).astype(np.float32)
            grain = np.kron(grain, np.ones((coarse, coarse), np.float32))[:height, :width]
            out[i, 0] = torch.from_numpy((grain > rng.uniform(0.2, 0.8)).astype(np.float32))
        elif choice < 0.85:
            side = rng.integers(2, 12)
            out[i, 0] = torch.from_numpy(((u // side + v // side) % 2).astype(np.float32))
        elif choice < 0.92:
            out[i] = float(rng.choice([0.0, 0.3, 1.0]))
        else:
            out[i] = 1.0 - images[i]
    return out
