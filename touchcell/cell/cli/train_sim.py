"""``touchcell train-sim``: the estimator for the simulated sensor, from simulated camera frames alone.

Frames are drawn as the simulated camera draws them and go through the model's own preprocessing, so that training and
serving cannot differ. The sensors scatter a little about the default one, so that the model learns the kind and not
one of them by heart. With a tip file they scatter about a real sensor, and labels are what its arm was commanded: such
an estimator reads the real sensor's images, as far as the simulation is true.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from touchcell.cell.cli.sim_recipes import DEEPEST_MM, Feels, SimRecipe, Tips
from touchcell.drivers.replay.dataset import FRAME_SIZE, PUBLIC_CROP
from touchcell.geometry import se3
from touchcell.geometry.types import ImageArray
from touchcell.perception.markers.detection import Discs
from touchcell.perception.models.architecture import Architecture
from touchcell.perception.models.marker_architecture import MarkerSize
from touchcell.perception.models.preprocessing import AdaptiveThreshold, Crop, Preprocessing
from touchcell.perception.networks.dataset import LabelledImages
from touchcell.perception.networks.progress import Display, Observer
from touchcell.perception.networks.training import Settings, train_on_arrays
from touchcell.perception.runtime.estimator_spec import Feature
from touchcell.simulation.edge_samples import edge_contacts
from touchcell.simulation.random_parts import steep_part
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.samples import USUAL_VARIATION, SampledContact, Variation, contacts
from touchcell.simulation.shape_samples import shape_contacts
from touchcell.simulation.tip import Tip, TipParameters
from touchcell.simulation.tip_file import TipFile, load_tip
from touchcell.simulation.tip_spread import TipSpread

if TYPE_CHECKING:
    from touchcell.perception.networks.marker_training import LabelledDiscs

PREPROCESSING = Preprocessing(
    input_size=(FRAME_SIZE[1], FRAME_SIZE[0]),
    crop=Crop(*PUBLIC_CROP),
    median_px=5,
    threshold=AdaptiveThreshold(block_px=61, offset=-5.0),
)
"""The paper's chain (3.1.3) with the crop of the public data."""

# Weights below 3 MB, so that the file can ship, and the rates that it was trained with.
ARCHITECTURE = Architecture(
    channels=(8, 16, 32, 64, 128),
    hidden=192,
    feature_dropout=0.05,
    mean_dropout=(0.05,) * 6,
    precision_dropout=(0.05,) * 6,
)

FITTED_VARIATION = Variation(
    parameters=0.002,
    turn_rad=0.0005,
    shift_px=0.1,
    marker_px=0.15,
    disc_radius=0.08,
    missing=0.003,
    field=0.01,
    slip=0.15,
)
"""About a real sensor, known better than the kind; ``field`` and ``slip`` are what its simulation cannot say."""

DETAIL_SETTINGS: Final[dict[str, Any]] = {
    "batch_size": 128,
    "learning_rate": 1.5e-3,
    "noise": 0.01,
    "shift_px": 0.1,
    "turn_rad": 0.0005,
    "zoom": 0.0003,
    "details": 120,
}
"""Edges and tilts are told by tenths of a pixel (docs/decisions/0051-edges-in-detail.md)."""

_SPREAD_PARAMETERS: Final = 0.02
"""Relative standard deviation of a tip's parameters about one that is drawn between those that are known."""
_NOISELESS: Final = replace(USUAL_VARIATION, marker_px=0.0)
_EDGE_SETTINGS: Final[dict[str, Any]] = {
    "hidden": (512, 640, 384),
    "marker_px": 0.07,
    "details": 160,
    "details_px": 0.07,
}
"""The noise is that of discs which were drawn and found again."""

_STEEP: Final = 0.4
"""Of the contacts with edges, on parts of what is rare among random ones."""
_STEEP_SEED: Final = 500_000
_OTHER_SEED: Final = 1_000_000
_MOST_VALIDATION: Final = 8000
"""Contacts of a validation set: more of them choose no other epoch."""

PUBLIC_SIZE = (PUBLIC_CROP[3] - PUBLIC_CROP[1], PUBLIC_CROP[2] - PUBLIC_CROP[0])
PUBLIC_MASK_PX = 216.0


@dataclass(frozen=True)
class Imagined:
    """What is simulated.

    Attributes:
        sensor: a real sensor's file, or None for the default tip.
        processed: images as the public data have them, cropped and black and white, rather than raw frames.
        feature: what the contacts are with.
        feels: ``plane`` presses on planes, as the paper does; ``shape`` on surfaces that bend. Edges are always shapes.
        tips: ``one`` scatters a little about that sensor; ``spread`` is of sensors as they differ, on surfaces.
        deepest_mm: largest depth; the smallest is the first touch.
    """

    sensor: TipFile | None = None
    processed: bool = False
    feature: Feature = "surface"
    feels: Feels = "plane"
    tips: Tips = "one"
    deepest_mm: float = DEEPEST_MM

    @property
    def tip(self) -> TipParameters:
        """Of the sensor in the middle."""
        return TipParameters() if self.sensor is None else self.sensor.tip

    @property
    def of_shapes(self) -> bool:
        """True if it touches more than planes."""
        return self.feature == "edge" or self.feels == "shape"

    def preprocessing(self, kind: str) -> Preprocessing:
        """That of an estimator for such images."""
        if kind == "markers":
            raw = PREPROCESSING.model_copy(update={"output_size": PUBLIC_SIZE})
            return Preprocessing(input_size=PUBLIC_SIZE, output_size=PUBLIC_SIZE) if self.processed else raw
        if self.processed:
            return Preprocessing(input_size=PUBLIC_SIZE, mask_radius_px=PUBLIC_MASK_PX)
        return PREPROCESSING

    def contacts(self, samples: int, seed: int) -> Iterator[SampledContact]:
        """Random ones."""
        if self.feature == "edge":
            steep = round(_STEEP * samples)
            usual = edge_contacts(samples - steep, seed, variation=_NOISELESS)
            return chain(usual, edge_contacts(steep, seed + _STEEP_SEED, variation=_NOISELESS, part=steep_part))
        depth_mm, variation, tips = (0.0, self.deepest_mm), USUAL_VARIATION, None
        if self.tips == "spread":
            variation, tips = replace(variation, parameters=_SPREAD_PARAMETERS), TipSpread().draw
        if self.feels == "shape":
            return shape_contacts(samples, seed, depth_mm=depth_mm, variation=variation, tips=tips)
        if self.sensor is None:
            return contacts(samples, seed, depth_mm=depth_mm, variation=variation, tips=tips)
        sensor = self.sensor
        return contacts(
            samples, seed, depth_mm=depth_mm, parameters=sensor.tip, rig=sensor.rig, variation=FITTED_VARIATION
        )


def train_on_simulation(out: Path, recipe: SimRecipe) -> None:
    """Draw training images and a fifth of that for validation, 8000 at most, train, and write the model file ``out``.

    The recipe's feature is a surface or an edge.

    Raises:
        ConfigError: the tip file cannot be used.
        TrainingError: as ``touchcell.perception.networks.training.train``.
    """
    assert recipe.feature != "kinds"
    tip = None if recipe.tip is None else load_tip(recipe.tip)
    imagined = Imagined(tip, recipe.processed, recipe.feature, recipe.feels, recipe.tips, recipe.deepest_mm)
    seed, epochs = recipe.seed, recipe.epochs
    with Display() as display:
        if recipe.kind == "markers":
            _train_markers(imagined, out, recipe.samples, epochs, seed, display)
            return
        training = draw(recipe.samples, seed, "train", display, imagined)
        validation = draw(_for_validation(recipe.samples), seed + _OTHER_SEED, "val", display, imagined)
        train_on_arrays(
            training,
            validation,
            out,
            preprocessing=imagined.preprocessing(recipe.kind),
            architecture=ARCHITECTURE.model_copy(update={"kind": recipe.kind}),
            settings=Settings(seed=seed, batch_size=32) if epochs is None else Settings(epochs, seed, batch_size=32),
            reference=_out_of_contact(seed, imagined, recipe.kind),
            observer=display,
        )


def _for_validation(samples: int) -> int:
    return min(samples // 5, _MOST_VALIDATION)


def _train_markers(
    imagined: Imagined, out: Path, samples: int, epochs: int | None, seed: int, observer: Observer
) -> None:
    from touchcell.perception.networks.marker_training import MarkerSettings, train_on_discs

    settings = MarkerSettings(seed=seed)
    if imagined.of_shapes:
        # One network in a file of 5 MB, which can ship. Its sensors scatter already, by what a camera is remounted.
        settings = replace(settings, hidden=(384, 384, 256), networks=1, **DETAIL_SETTINGS)
    if imagined.feature == "edge":
        settings = replace(settings, **_EDGE_SETTINGS)
    train_on_discs(
        _discs(imagined, samples, seed, matched=False, observer=observer),
        _discs(imagined, _for_validation(samples), seed + _OTHER_SEED, matched=True, observer=observer),
        out,
        preprocessing=imagined.preprocessing("markers"),
        size=MarkerSize.of_disc(np.pi * imagined.tip.disc_radius_px**2),
        settings=settings if epochs is None else replace(settings, epochs=epochs),
        reference=_out_of_contact(seed, imagined, "markers"),
        observer=observer,
    )


def _discs(
    imagined: Imagined, samples: int, seed: int, *, matched: bool, observer: Observer | None = None
) -> LabelledDiscs:
    """Discs of simulated frames, without the frames; known markers alone where they need not be ``matched`` either."""
    from touchcell.perception.networks.marker_learning import KnownMarkers
    from touchcell.perception.networks.marker_training import LabelledDiscs

    height, width = PUBLIC_SIZE
    corner = np.array(PUBLIC_CROP[:2], dtype=np.float64)
    frames, labels = [], np.empty((samples, 4, 4))
    middle, known = Tip(imagined.tip), None
    reference = middle.project(middle.rest_positions) - corner
    if imagined.of_shapes:
        # Of hundreds of thousands of contacts float64 would take gigabytes more.
        moved = np.empty((samples, len(reference), 2), np.float32)
        known = KnownMarkers(reference, moved, np.empty((samples, len(reference)), np.bool_))
    for i, contact in enumerate(imagined.contacts(samples, seed)):
        if observer is not None and i % 1000 == 0:
            observer.images("drawn", i, samples)
        centres = contact.markers - corner
        reach = contact.disc_radius_px
        whole = ((centres >= reach) & (centres <= np.array([width, height]) - 1.0 - reach)).all(axis=1) & contact.seen
        labels[i] = contact.T_f_s
        if known is not None:
            known.displacements[i], known.seen[i] = centres - reference, whole
        if known is None or matched:
            frames.append(Discs(centres[whole], np.full(int(whole.sum()), np.pi * reach**2)))
    return LabelledDiscs(frames, se3.log(se3.inverse(labels)), known)


def draw(samples: int, seed: int, split: str, observer: Observer, imagined: Imagined | None = None) -> LabelledImages:
    """Preprocessed simulated frames with their labels, the same for the same seed."""
    imagined = imagined or Imagined()
    preprocessing = imagined.preprocessing("gdn")
    height, width = preprocessing.output_size
    images: ImageArray = np.empty((samples, height, width), np.uint8)
    labels = np.empty((samples, 4, 4))
    renderers: dict[float, FrameRenderer] = {}
    for i, contact in enumerate(imagined.contacts(samples, seed)):
        # A renderer draws discs of one radius; a twentieth of a pixel is finer than anybody sees.
        radius_px = round(20 * contact.disc_radius_px) / 20
        if radius_px not in renderers:
            renderers[radius_px] = FrameRenderer(radius_px, seed=seed)
        renderer = renderers[radius_px]
        frame = renderer.processed(contact.pixels) if imagined.processed else renderer.raw(contact.pixels, i)
        images[i] = preprocessing.reduce(frame)
        labels[i] = contact.T_f_s
        if i % 100 == 0:
            observer.images(split, i, samples)
    observer.images(split, samples, samples)
    return LabelledImages(images, se3.log(se3.inverse(labels)))


def _out_of_contact(seed: int, imagined: Imagined, kind: str) -> ImageArray:
    """What the sensor in the middle sees when it touches nothing."""
    tip = Tip(imagined.tip)
    rest, renderer = tip.project(tip.rest_positions), FrameRenderer(tip.parameters.disc_radius_px, seed=seed)
    frame = renderer.processed(rest) if imagined.processed else renderer.raw(rest)
    return imagined.preprocessing(kind).reduce(frame)
