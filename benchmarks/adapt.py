"""``touchcell bench adapt``: accuracy over the number of labelled images of another sensor used for adaptation.

A second real sensor is not available. One table is of real images that were rotated, zoomed and shifted, with labels
about other axes; the other of a simulated sensor with another camera, mount, stiffness, skin and grip than the one that
a model was trained on.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from benchmarks.calibration import changed
from touchcell.drivers.replay.dataset import read_image, read_split
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.calibration.adaptation import (
    AdaptSettings,
    about_z,
    adapt_to,
    align_to_sensor,
    layers_of,
    outputs_of,
    tune,
)
from touchcell.perception.calibration.marked_data import evenly
from touchcell.perception.markers.detection import Discs, detect_markers
from touchcell.perception.markers.estimator import matcher_of
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.networks.marker_training import LabelledDiscs
from touchcell.simulation.mount import MountModel
from touchcell.simulation.samples import Variation, contacts
from touchcell.simulation.tip import TipParameters
from touchcell.simulation.tip_file import load_tip

COUNTS = (20, 50, 100, 200)
_ORDER = (2, 3, 4, 0, 1, 5)

_SCRATCH = AdaptSettings(steps=600, learning_rate=2e-3, hold=0.0, batch_size=64)
_TURN_DEG, _ZOOM, _SHIFT_PX, _AXES_DEG = 70.0, 0.95, 6.0, 25.0


@dataclass(frozen=True)
class Case:
    """Another sensor.

    Attributes:
        title: of the table.
        model: model to be adapted.
        few: images to adapt with.
        held_out: images to measure on.
        size: of its markers.
        best: errors of a model that was trained on all images of this sensor, and its description.
    """

    title: str
    model: Model
    few: LabelledDiscs
    held_out: LabelledDiscs
    size: MarkerSize
    best: tuple[str, Array] | None = None

    def some(self, count: int) -> LabelledDiscs:
        """Return that many of the images to adapt with, evenly chosen."""
        chosen = evenly(len(self.few.frames), count)
        return LabelledDiscs([self.few.frames[i] for i in chosen], self.few.xi[chosen])


def run(arguments: Sequence[str], out: Path) -> None:
    """Measure, print, and write ``adapt.md``."""
    parser = argparse.ArgumentParser("touchcell bench adapt")
    parser.add_argument("--data", type=Path, help="real images for the first table")
    parser.add_argument("--model", type=Path, help="marker model that was trained on them")
    parser.add_argument("--sim-model", type=Path, help="of `train-sim --kind markers --processed --tip TIP`")
    parser.add_argument("--tip", default="franka_tactip_1", help="that TIP")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="images to adapt with, ascending")
    parser.add_argument("--held-out", type=int, default=400, help="images to measure on")
    options = parser.parse_args(arguments)
    cases: list[Case] = []
    if options.data is not None and options.model is not None:
        cases.append(_real(options.data, options.model, options.held_out))
    if options.sim_model is not None:
        cases.append(_simulated(options.sim_model, options.tip, options.held_out))
    if not cases:
        parser.error("give --data and --model, or --sim-model")
    lines = []
    for case in cases:
        table = Table(title=case.title)
        columns = ("", "z", "alpha", "beta", "x", "y", "gamma", "matched")
        for name in columns:
            table.add_column(name, justify="right" if name else "left")
        lines += ["", case.title, "", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
        for name, mae, matched in _rows(case, options.counts):
            row = [name, *(f"{mae[i]:.3f}" for i in _ORDER), "" if matched is None else f"{100 * matched:.1f} %"]
            table.add_row(*row)
            print("  ".join(row), flush=True)
            lines.append("| " + " | ".join(row) + " |")
        Console(width=130).print(table)
    (out / "adapt.md").write_text("\n".join(lines).lstrip() + "\n", encoding="utf-8")


def _rows(case: Case, counts: Sequence[int]) -> Iterator[tuple[str, Array, float | None]]:
    old = case.model
    yield "before", *_errors(old, case.held_out)
    adapted = old
    for count in counts:
        adapted = _adapted(case, count)
        yield f"after {count} images", *_errors(adapted, case.held_out)
    yield f"networks from scratch on {counts[-1]}", *_errors(_scratch(case, adapted, counts[-1]), case.held_out)
    if case.best is not None:
        yield case.best[0], case.best[1], None


def _adapted(case: Case, count: int) -> Model:
    return adapt_to(case.model, case.some(count), preprocessing=case.model.header.preprocessing, size=case.size)


def _scratch(case: Case, adapted: Model, count: int) -> Model:
    """Return networks trained from scratch; camera and matching are given to them."""
    few = case.some(count)
    brought = align_to_sensor(case.model, few)
    rng = np.random.default_rng(0)
    layers = []
    for i, (weight, bias) in enumerate(layers_of(adapted)):
        # First weights are per pixel: displacements have a magnitude of eight.
        scale = 1.0 / np.sqrt(weight.shape[1]) / (8.0 if i == 0 else 1.0)
        layers.append((rng.uniform(-scale, scale, weight.shape), np.zeros_like(bias)))
    target = adapted.header.labels.targets(about_z(brought.turn_rad, few.xi[brought.matched]))
    trained = tune(case.model, layers, brought.displacements[brought.matched], target, _SCRATCH)
    tensors = dict(adapted.tensors)
    for i, (weight, bias) in enumerate(trained):
        tensors |= {f"layer{i}.weight": weight.astype(np.float32), f"layer{i}.bias": bias.astype(np.float32)}
    return Model(adapted.header, tensors)


def _errors(model: Model, contacts: LabelledDiscs) -> tuple[Array, float]:
    """Return the MAE (6,) of x, y, z, alpha, beta, gamma, mm and deg.

    And the fraction of images with matched markers.
    """
    architecture = model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    matcher, camera = matcher_of(model, architecture), model.header.camera
    frames = contacts.frames
    if camera is not None:
        frames = [Discs(camera.points(discs.centres), discs.areas) for discs in frames]
    fields = [matcher.match(discs) for discs in frames]
    displacements = np.stack([each.displacements.ravel() for each in fields]).astype(np.float32)
    mean, _ = outputs_of(layers_of(model), displacements, model.header.labels)
    mean[[not each.seen.any() for each in fields]] = 0.0
    xi = xi_from_contact(model.header.labels.contacts(mean))
    found = contact_from_xi(about_z(-np.radians(model.header.label_turn_deg), xi))
    mae: Array = np.abs(found - contact_from_xi(contacts.xi)).mean(axis=0)
    return mae, float(np.mean([each.valid for each in fields]))


def _real(data: Path, path: Path, held_out: int) -> Case:
    model = load_model(path)
    architecture = model.header.architecture
    if not isinstance(architecture, MarkerArchitecture):
        raise SystemExit(f"{path} is not a marker model")
    sets, unchanged = {}, None
    for name, wanted in (("train", COUNTS[-1]), ("val", held_out)):
        split = read_split(data, name)
        chosen = evenly(len(split.images), wanted)
        images = [model.header.preprocessing.reduce(read_image(split.images[i])) for i in chosen]
        xi = xi_from_contact(split.contact_mm_deg[chosen])
        if name == "val":
            unchanged = LabelledDiscs([detect_markers(image, architecture.size) for image in images], xi)
        other = [changed(image, _ZOOM, _TURN_DEG, _SHIFT_PX) for image in images]
        sets[name] = LabelledDiscs(
            [detect_markers(image, architecture.size) for image in other], about_z(np.radians(_AXES_DEG), xi)
        )
    assert unchanged is not None
    title = (
        f"real images, rotated by {_TURN_DEG:g} deg, zoomed {_ZOOM:g}, shifted {_SHIFT_PX:g} px; labels' axes turned"
    )
    best = ("trained on all, unchanged images", _errors(model, unchanged)[0])
    return Case(title, model, sets["train"], sets["val"], architecture.size, best)


def _simulated(path: Path, tip: str, held_out: int) -> Case:
    model = load_model(path)
    architecture = model.header.architecture
    if not isinstance(architecture, MarkerArchitecture):
        raise SystemExit(f"{path} is not a marker model")
    sensor = load_tip(tip)
    other_tip, other_rig = second_sensor(sensor.tip, sensor.rig)
    few = _drawn(other_tip, other_rig, COUNTS[-1], 11, model)
    measured = _drawn(other_tip, other_rig, held_out, 12, model)
    first = _drawn(sensor.tip, sensor.rig, held_out, 12, model)
    best = ("the old sensor, by the old model", _errors(model, first)[0])
    title = "a simulated sensor with another camera, mount, stiffness, skin and grip"
    return Case(title, model, few, measured, architecture.size, best)


def second_sensor(tip: TipParameters, rig: MountModel) -> tuple[TipParameters, MountModel]:
    """Return another sensor of the kind."""
    u, v = tip.centre_px
    other = replace(
        tip,
        image_rotation_rad=tip.image_rotation_rad + np.radians(100.0),
        layout_phase_rad=tip.layout_phase_rad + np.radians(23.0),
        focal_px=0.94 * tip.focal_px,
        centre_px=(u - 7.0, v + 9.0),
        camera_tilt_rad=(0.02, -0.015),
        dent_follow=0.93 * tip.dent_follow,
        dent_width_rad_per_sqrt_m=1.08 * tip.dent_width_rad_per_sqrt_m,
        rock=0.85 * tip.rock,
        rim_follow=1.1 * tip.rim_follow,
    )
    mounted = replace(
        rig,
        offset_m=(1.0e-3, -0.8e-3),
        depth_m=0.2e-3,
        level_rad=(0.012, -0.006),
        slip_at_1mm_m=1.3 * rig.slip_at_1mm_m,
    )
    return other, mounted


def _drawn(tip: TipParameters, rig: MountModel, n: int, seed: int, model: Model) -> LabelledDiscs:
    """Return discs of simulated contacts, deepest last."""
    still = Variation(0.0, 0.0, 0.0, 0.15, 0.0, 0.003, field=0.01, slip=0.15)
    height, width = model.header.preprocessing.output_size
    frames, labels = [], []
    for contact in contacts(n, seed, parameters=tip, rig=rig, variation=still):
        centres = contact.pixels - np.array([105.0, 20.0])
        inside = ((centres >= 6.0) & (centres <= np.array([width, height]) - 7.0)).all(axis=1)
        frames.append(Discs(centres[inside], np.full(int(inside.sum()), np.pi * contact.disc_radius_px**2)))
        labels.append(contact.T_f_s)
    order = np.argsort([T[2, 3] for T in labels])
    xi = se3.log(se3.inverse(np.stack(labels)))[order]
    return LabelledDiscs([frames[i] for i in order], xi)
