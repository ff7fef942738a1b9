"""Learn where an image network's estimates expect the tip's markers: the check of ``markers.image_check``. NumPy only.

Nothing but the training images and the trained network is needed. The markers of an image at rest are found as a
lattice. From there the polynomial from means to places is fitted to more and more images, in the order of how far their
means are from those at rest: it predicts the next ones well enough for mean shift to find their markers.

Images are then moved, turned and mirrored as a camera might be. Fisher's linear discriminant between the fields of
changed and of plain images names the change; limits are set on images that none of this was fitted to.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from touchcell.geometry.types import Array, ImageArray
from touchcell.perception import kernels
from touchcell.perception.markers.camera_check import principal
from touchcell.perception.markers.detection import Discs, rings_of
from touchcell.perception.markers.image_check import TURNS, ImageCheck, SeenMarkers, px_of_crop, terms_of
from touchcell.perception.markers.lattice_fit import fit_lattice
from touchcell.perception.models.architecture import CHECK, ImageCheckSpec
from touchcell.perception.models.preprocessing import Preprocessing

Means = Callable[[ImageArray], NDArray[np.float32]]
"""From preprocessed images (n, height, width) to a network's means (n, 6)."""

LEAST_IMAGES = 200
_MOST_IMAGES = 3000
_CANDIDATES, _MOST_RINGS = 60, 16
_RADIUS = 0.48  # Of the spacing: half way to the next marker.
_LEVEL = 0.3  # Of the median marker at rest.
_SHARES = (0.04, 0.055, 0.075, 0.1, 0.135, 0.18, 0.25, 0.33, 0.45, 0.6, 0.8, 1.0, 1.0, 1.0)
_FIRST_DEGREE_TO, _SECOND_DEGREE_TO = 0.1, 0.5
_RIDGE = 1e-5
_MODES, _FILTER_MODES = 40, 80
_NOISE_PX = 0.5
_LEAST_SEEN = 0.93
_CHANGED, _LEAST_ALIKE = 250, 12
_ACCEPTED, _FOUND = 0.99, 0.02
# Of size and roughness: another tip of the kind deforms a little otherwise, smoothly; what is torn or moved is rough.
_SPARE_FIELD = np.array([1.6, 1.1])
_SPARE, _SPARE_LIGHT, _LEAST_LIMIT = 1.1, 0.75, 0.6
_ZOOM, _TURN_DEG, _SHIFT = 1.05, 2.5, 0.0225  # Of the image's side: 10 px of 445.
# Of each monomial: at one half it is worth a power of it.
_DEGREES = np.rint(-np.log2(terms_of(np.full(6, 0.5)))).astype(int)


def learn_image_check(
    images: ImageArray,
    means_of: Means,
    preprocessing: Preprocessing,
    *,
    rest: ImageArray | None = None,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[ImageCheckSpec, dict[str, NDArray[np.float32]]] | None:
    """Return the check of an image network and its tensors; None where the markers cannot be followed.

    Args:
        images: uint8 (n, height, width), preprocessed, of the sensor's contacts.
        means_of: the trained network.
        preprocessing: of the model.
        rest: preprocessed image out of contact; None takes the least deformed one.
        seed: of the choice of images.
        progress: called with the steps done and their number.
    """
    if len(images) < LEAST_IMAGES:
        return None
    images = images[np.random.default_rng(seed).permutation(len(images))[:_MOST_IMAGES]]
    found = _rest_markers(images[:_CANDIDATES] if rest is None else rest[None])
    if found is None:
        return None
    which, lattice = found
    rest = images[which] if rest is None else rest
    means = means_of(images)
    # A network knows nothing of an image out of contact: growth begins with the images most like it.
    unlike = np.abs(images.astype(np.int16) - rest).mean(axis=(1, 2))
    middle = means[np.argsort(unlike)[: max(8, len(images) // 100)]].mean(axis=0)
    order = np.argsort(np.linalg.norm(means - middle, axis=1))
    aside = np.arange(len(order)) % 4 == 3
    spec, tensors = _at_rest(rest, lattice, preprocessing)
    taught = order[~aside]
    for step, share in enumerate(_SHARES):
        some = taught[: max(min(len(taught), 40), int(share * len(taught)))]
        degree = 1 + (share > _FIRST_DEGREE_TO) + (share > _SECOND_DEGREE_TO)
        spec, tensors = _fitted(
            images[some], means[some], degree, ImageCheck(spec, tensors, preprocessing), spec, tensors
        )
        if progress is not None:
            progress(step + 1, len(_SHARES) + 1)
    check = ImageCheck(spec, tensors, preprocessing)
    markers = [check.find(images[i], means[i]) for i in order]
    if np.quantile([each.seen.mean() for each in markers], _FOUND) < _LEAST_SEEN:
        return None
    kept = [each for each, kept in zip(markers, aside, strict=True) if kept]
    limits = _SPARE_FIELD * np.quantile([check.measure(each) for each in kept], _ACCEPTED, axis=0)
    changed = _changed_fields(images[order[:: max(1, len(order) // _CHANGED)]], means_of, check, lattice, limits)
    fields = np.stack([_field(each) for each, kept in zip(markers, aside, strict=True) if not kept])
    filters = _filters(fields, {name: each[::2] for name, each in changed.items()})
    for i, each in enumerate(changed.values()):
        mean = tensors[f"{CHECK}mean"]
        plain = [float(filters[i] @ (_field(each) - mean)) for each in kept]
        limit = _SPARE * float(np.quantile(plain, _ACCEPTED))
        least = float(np.quantile((each[1::2] - mean) @ filters[i], _FOUND))
        # As with marker models, cameras that have moved by less than this estimate well enough.
        limits = np.append(limits, max(0.5 * (limit + least) if least > 2.0 * limit else limit, _LEAST_LIMIT))
    tensors |= {f"{CHECK}filters": filters}
    if progress is not None:
        progress(len(_SHARES) + 1, len(_SHARES) + 1)
    light = float(np.quantile([each.light for each in markers], 0.002))
    limited = {"limits": tuple(limits.tolist()), "changes": tuple(changed), "least_light": _SPARE_LIGHT * light}
    return spec.model_copy(update=limited), tensors


def _rest_markers(images: ImageArray) -> tuple[int, Array] | None:
    """Return the index of the image that shows a lattice best, and its (m, 2) px markers."""
    best: tuple[float, int, Array] | None = None
    for i, image in enumerate(images):
        centres = _peaks(image)
        rings = rings_of(len(centres))
        for count in (rings, rings + 1):
            if not 1 < count <= _MOST_RINGS:
                continue
            points, rms = fit_lattice(Discs(centres, np.ones(len(centres))), count)
            if np.isfinite(rms) and (best is None or rms < best[0]):
                best = (rms, i, points)
    return None if best is None else best[1:]


def _peaks(image: ImageArray) -> Array:
    """Return (n, 2) px local maxima of a smoothed image, (u, v)."""
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.8)
    highest = cv2.dilate(smooth, np.ones((3, 3), np.uint8))
    rows, columns = np.nonzero((smooth >= highest) & (smooth > 0.3 * float(smooth.max())))
    return np.column_stack([columns, rows]).astype(np.float64)


def _at_rest(
    rest: ImageArray, lattice: Array, preprocessing: Preprocessing
) -> tuple[ImageCheckSpec, dict[str, NDArray[np.float32]]]:
    """Return a check that expects the markers where they are at rest, with no limits."""
    apart = np.linalg.norm(lattice[:, None] - lattice[None], axis=2)
    np.fill_diagonal(apart, np.inf)
    radius = max(_RADIUS * float(np.median(apart.min(axis=1))), 0.75)
    places, levels = kernels.mean_shift(rest, lattice, radius, TURNS)
    light = float(rest.sum(dtype=np.int64)) / 255.0 / len(places)
    spec = ImageCheckSpec(
        markers=len(places),
        radius_px=radius,
        disc_px=math.sqrt(light / np.pi),
        least_level=max(_LEVEL * float(np.median(levels)), 1.0),
        least_light=0.0,
        modes=1,
        limits=(1.0, 1.0),
        changes=(),
    )
    wide = 2 * len(places)
    shapes = {"terms": (len(_DEGREES), wide), "mean": (wide,), "modes": (1, wide), "filters": (0, wide)}
    tensors = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    tensors["sd"] = np.ones(1, np.float32)
    tensors["rest"] = ((places + 0.5) * px_of_crop(preprocessing) - 0.5).astype(np.float32)
    return spec, {f"{CHECK}{name}": each for name, each in tensors.items()}


def _fitted(
    images: ImageArray,
    means: NDArray[np.float32],
    degree: int,
    check: ImageCheck,
    spec: ImageCheckSpec,
    tensors: dict[str, NDArray[np.float32]],
) -> tuple[ImageCheckSpec, dict[str, NDArray[np.float32]]]:
    """Return a check whose terms and modes are fitted to the markers that ``check`` finds in images (n, h, w)."""
    rest = tensors[f"{CHECK}rest"].astype(np.float64)
    markers = [check.find(image, mean) for image, mean in zip(images, means, strict=True)]
    off = np.stack([(each.expected + each.off - rest).ravel() for each in markers])
    used = np.flatnonzero(degree >= _DEGREES)
    terms = terms_of(means.astype(np.float64))[:, used]
    coefficients = np.zeros((len(_DEGREES), rest.size))
    moments = terms.T @ terms + _RIDGE * len(images) * np.eye(len(used))
    coefficients[used] = np.linalg.solve(moments, terms.T @ off)
    left = off - terms @ coefficients[used]
    mean = left.mean(axis=0)
    modes, sd = principal(left - mean, min(_MODES, len(images) // 4))
    fitted = {"terms": coefficients, "mean": mean, "modes": modes, "sd": np.maximum(sd, 1e-3)}
    return (
        spec.model_copy(update={"modes": len(sd)}),
        tensors | {f"{CHECK}{name}": each.astype(np.float32) for name, each in fitted.items()},
    )


def _field(markers: SeenMarkers) -> Array:
    return markers.off.ravel()


def _changed_fields(
    images: ImageArray, means_of: Means, check: ImageCheck, lattice: Array, limits: Array
) -> dict[str, Array]:
    """Return the fields (n, 2 m) px of images as cameras that have moved would take them, by what has happened.

    Only those whose size and roughness are within ``limits`` (2,), and only changes that have some of them.
    """
    height, width = images.shape[1:]
    middle = (width / 2.0 - 0.5, height / 2.0 - 0.5)
    u, v = lattice.mean(axis=0).tolist()
    shift = _SHIFT * width
    changes = {
        "the camera's image is larger than the model's": _motion(middle, zoom=_ZOOM),
        "the camera's image is smaller than the model's": _motion(middle, zoom=1.0 / _ZOOM),
        "the camera's image is shifted to the right": _motion(middle, shift=(shift, 0.0)),
        "the camera's image is shifted to the left": _motion(middle, shift=(-shift, 0.0)),
        "the camera's image is shifted downwards": _motion(middle, shift=(0.0, shift)),
        "the camera's image is shifted upwards": _motion(middle, shift=(0.0, -shift)),
        "the camera is turned anticlockwise": _motion(middle, turn_deg=_TURN_DEG),
        "the camera is turned clockwise": _motion(middle, turn_deg=-_TURN_DEG),
    }
    for sixths in range(1, 6):
        changes[f"the camera is turned by about {60 * sixths} deg"] = _motion((u, v), turn_deg=60.0 * sixths)
    for sixths in range(6):
        turned = _motion((u, v), turn_deg=60.0 * sixths)
        mirror = np.array([[-1.0, 0.0, 2.0 * u], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
        changes[f"the camera is mirrored, at {30 * sixths} deg"] = turned @ mirror
    found = {}
    for name, matrix in changes.items():
        moved = np.stack(
            [cv2.warpAffine(each, matrix[:2], (width, height), flags=cv2.INTER_CUBIC) for each in images]
        ).astype(np.uint8)
        means = means_of(moved)
        markers = [check.find(image, mean) for image, mean in zip(moved, means, strict=True)]
        alike = [_field(each) for each in markers if (check.measure(each)[:2] <= limits).all()]
        if len(alike) >= _LEAST_ALIKE:
            found[name] = np.stack(alike)
    return found


def _motion(
    centre: tuple[float, float], *, zoom: float = 1.0, turn_deg: float = 0.0, shift: tuple[float, float] = (0.0, 0.0)
) -> Array:
    matrix = np.eye(3)
    matrix[:2] = cv2.getRotationMatrix2D(centre, turn_deg, zoom)
    matrix[:2, 2] += shift
    return matrix


def _filters(plain: Array, changed: dict[str, Array]) -> NDArray[np.float32]:
    """Return Fisher's discriminants (k, 2 m) of changed fields (n, 2 m) px from plain ones, each one for its change."""
    mean = plain.mean(axis=0)
    rows, sd = principal(plain - mean, min(_FILTER_MODES, len(plain) // 4))
    shares = 1.0 / _NOISE_PX**2 - 1.0 / (sd**2 + _NOISE_PX**2)
    filters = np.zeros((len(changed), plain.shape[1]), np.float32)
    for i, fields in enumerate(changed.values()):
        away = fields.mean(axis=0) - mean
        toward = away / _NOISE_PX**2 - ((rows @ away) * shares) @ rows
        filters[i] = toward / max(float(toward @ away), 1e-9)
    return filters
