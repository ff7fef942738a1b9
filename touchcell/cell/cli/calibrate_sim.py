"""``touchcell calibrate-sim``: the simulated tip made like a real one, from a score of labelled images.

Images of ``train`` teach, without labels, which marker is where. The labels of a few then give camera, mount, slip and
skin; others of ``train``, and some of ``val`` where there is one, tell how far other markers are off.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table

from touchcell.drivers.replay.dataset import Split, read_image, read_split, split_folder
from touchcell.geometry.types import Array
from touchcell.perception.calibration.marked_data import MarkedContacts, SensorMarkers, evenly, learn_sensor
from touchcell.progress import shown_progress
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.tip_file import TipFile, save_tip
from touchcell.simulation.tip_fit import Sensor, fit_tip

if TYPE_CHECKING:
    pass

DEPTHS_MM = (0.0, 1.5, 2.5, 3.5, 4.5, 10.0)
_HELD_OUT = 200
_SHOWN = 5


@dataclass(frozen=True)
class MarkerErrors:
    """How far simulated markers are from real ones in one set of images.

    Attributes:
        images: how many.
        moved_px: how far the contacts moved the markers, on average.
        mean_px, median_px, p95_px: of the errors.
        bands_px: mean, and the images' number, by depth band in mm.
    """

    images: int
    moved_px: float
    mean_px: float
    median_px: float
    p95_px: float
    bands_px: Mapping[str, tuple[float, int]]


def calibrate_sim(
    data: Path,
    out: Path,
    *,
    frames: int = 20,
    images: int = 600,
    rings: int = 10,
    guess_steps: int = 600,
    seed: int = 0,
) -> None:
    """Fit, print marker errors, and write the tip file ``out`` with a picture beside it.

    Args:
        data: data set with ``train``; images must be 640x480 frames or the public crop of them.
        out: ``NAME.yaml``.
        frames: labelled images that are fitted to.
        images: of ``train`` that teach, without labels, how the markers move.
        rings: of the sensor's lattice.
        guess_steps: as of ``marker_learning.learn_markers``.
        seed: of everything random.

    Raises:
        DataError: the data set is damaged.
        TrainingError: no lattice is found, or nothing explains the images.
        ImageError: the images are of another size.
    """
    console = Console(width=None if sys.stdout.isatty() else 120)
    training = read_split(data, "train")
    with shown_progress() as show:
        markers = learn_sensor(data, images=images, rings=rings, guess_steps=guess_steps, seed=seed, progress=show)
        by_depth = np.argsort(training.contact_mm_deg[:, 2], kind="stable")
        chosen = by_depth[evenly(len(by_depth), frames)]
        rest = by_depth[~np.isin(by_depth, chosen)]
        others = rest[evenly(len(rest), _HELD_OUT)]
        contacts, fitted_to = markers.contacts(training, chosen, show)
        sensor = fit_tip(contacts, markers.reference, rings, progress=partial(show, "fitted"))
        sensor = replace(sensor, tip=replace(sensor.tip, disc_radius_px=markers.disc_radius_px))
        held_out, shown = markers.contacts(training, others, show)
        sets = {"fitted to": contacts, "train, held out": held_out}
        if split_folder(data, "val").is_dir():
            validation = read_split(data, "val")
            some = np.array(evenly(len(validation.images), _HELD_OUT), np.intp)
            sets["val, held out"] = markers.contacts(validation, some, show)[0]
    found = {name: marker_errors(sensor, each, markers.reference) for name, each in sets.items()}
    measured: dict[str, str | int | float | dict[str, float]] = {
        "command": f"touchcell calibrate-sim --frames {frames} --images {images} --seed {seed}",
        "frames": len(fitted_to),
        **{f"{name} px": round(each.mean_px, 3) for name, each in found.items()},
    }
    save_tip(TipFile(tip=sensor.tip, rig=sensor.rig, measured=measured), out)
    picture = out.with_suffix(".png")
    _write_picture(picture, markers, training, sensor, held_out, shown)
    _print(console, found)
    console.print(
        f"{len(fitted_to)} of {frames} images matched and fitted to; wrote {out} and {picture}", soft_wrap=True
    )


def marker_errors(sensor: Sensor, contacts: MarkedContacts, reference: Array) -> MarkerErrors:
    """Errors of a simulated sensor in labelled contacts.

    Args:
        sensor: simulated.
        contacts: measured.
        reference: (m, 2) px of the undeformed markers.
    """
    errors = sensor.errors(contacts)
    depth_mm = 1e3 * contacts.T_f_s[:, 2, 3]
    moved = np.linalg.norm(contacts.pixels - reference, axis=2)[contacts.seen]
    bands = {}
    for low, high in itertools.pairwise(DEPTHS_MM):
        inside = (depth_mm > low) & (depth_mm <= high)
        if inside.any():
            bands[f"{low:g}-{high:g}"] = (float(np.nanmean(errors[inside])), int(inside.sum()))
    return MarkerErrors(
        images=len(contacts),
        moved_px=float(moved.mean()),
        mean_px=float(np.nanmean(errors)),
        median_px=float(np.nanmedian(errors)),
        p95_px=float(np.nanpercentile(errors, 95)),
        bands_px=bands,
    )


def _print(console: Console, found: Mapping[str, MarkerErrors]) -> None:
    table = Table(title="markers, simulated to real, px")
    bands = list(dict.fromkeys(band for each in found.values() for band in each.bands_px))
    for column in ("", "images", "moved by", "mean", "median", "95 %", *(f"{band} mm" for band in bands)):
        table.add_column(column, justify="right" if column else "left")
    for name, each in found.items():
        by_depth = [f"{each.bands_px[band][0]:.2f}" if band in each.bands_px else "" for band in bands]
        numbers = (each.moved_px, each.mean_px, each.median_px, each.p95_px)
        table.add_row(name, str(each.images), *(f"{number:.2f}" for number in numbers), *by_depth)
    console.print(table)


def _write_picture(
    path: Path,
    markers: SensorMarkers,
    split: Split,
    sensor: Sensor,
    contacts: MarkedContacts,
    numbers: NDArray[np.intp],
) -> None:
    from touchcell.simulation.tip_figures import write_comparison

    columns = np.linspace(0, len(numbers) - 1, _SHOWN).round().astype(int)
    real, simulated, measured, predicted, titles = [], [], [], [], []
    renderer = FrameRenderer(sensor.tip.disc_radius_px)
    pixels = sensor.pixels(contacts.T_f_s[columns])
    for column, places in zip(columns, pixels, strict=True):
        image = markers.preprocessing.reduce(read_image(split.images[numbers[column]]))
        real.append(image)
        drawn = renderer.processed(places) if markers.origin.any() else renderer.raw(places)
        simulated.append(drawn if markers.origin.any() else markers.preprocessing.reduce(drawn))
        seen = contacts.seen[column]
        measured.append(contacts.pixels[column][seen] - markers.origin)
        predicted.append(places[seen] - markers.origin)
        x, y, z, alpha, beta, gamma = split.contact_mm_deg[numbers[column]]
        titles.append(f"z {z:.1f}, shear {x:.1f} {y:.1f} mm\ntilt {alpha:.0f} {beta:.0f}, twist {gamma:.0f} deg")
    write_comparison(path, real, simulated, measured, predicted, titles)
