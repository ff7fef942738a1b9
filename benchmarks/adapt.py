"""``touchcell bench adapt``: accuracy over the number of labelled images of another sensor used for adaptation.

One table is of a second real sensor, the other of a simulated one with another camera, mount, stiffness, skin and grip
than the one that a model was trained on. Images to adapt with are drawn at random, several times, but once where they
are all; errors are of images that were not among them. Where they are all, the Gaussian processes alone are also fitted
to nine tenths of them, ten times, and judged on the tenth that each fit has not seen.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from touchcell.drivers.replay.dataset import read_image, read_split
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.calibration.adaptation import adapt_to, align_camera
from touchcell.perception.calibration.transfer_fit import fit_transfer, old_sensor
from touchcell.perception.errors import TrainingError
from touchcell.perception.markers.detection import Discs, detect_markers, typical_size
from touchcell.perception.markers.estimator import MarkerEstimator, displacement_model_of
from touchcell.perception.markers.layers import layers_of
from touchcell.perception.models.labels import contact_from_xi, xi_from_contact
from touchcell.perception.models.marker_architecture import MarkerArchitecture, MarkerSize
from touchcell.perception.models.model_file import Model, load_model
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.networks.marker_training import LabelledDiscs, preprocessing_for
from touchcell.perception.networks.scores import Scores
from touchcell.simulation.mount import MountModel
from touchcell.simulation.samples import Variation, contacts
from touchcell.simulation.tip import TipParameters
from touchcell.simulation.tip_file import load_tip

COUNTS = (20, 50, 200)
_DRAWN = 400
_PARTS = 10


@dataclass(frozen=True)
class Case:
    """Another sensor.

    Attributes:
        title: of the table.
        model: model to be adapted.
        contacts: of the other sensor, to adapt with and to measure on.
        preprocessing: of its images.
        size: of its markers.
    """

    title: str
    model: Model
    contacts: LabelledDiscs
    preprocessing: Preprocessing
    size: MarkerSize

    def some(self, chosen: NDArray[np.int64]) -> LabelledDiscs:
        """Return some of the contacts."""
        return LabelledDiscs([self.contacts.frames[i] for i in chosen], self.contacts.xi[chosen])


def run(arguments: Sequence[str], out: Path) -> None:
    """Measure, print, and write ``adapt.md``."""
    parser = argparse.ArgumentParser("touchcell bench adapt")
    parser.add_argument("--data", type=Path, help="labelled images of a second real sensor, for the first table")
    parser.add_argument("--model", type=Path, help="marker model of the first real sensor")
    parser.add_argument("--sim-model", type=Path, help="of `train-sim --kind markers --processed --tip TIP`")
    parser.add_argument("--tip", default="franka_tactip_1", help="that TIP")
    parser.add_argument("--counts", type=int, nargs="+", default=COUNTS, help="images to adapt with")
    parser.add_argument("--seeds", type=int, default=3, help="draws of the images for each count")
    options = parser.parse_args(arguments)
    cases: list[Case] = []
    if options.data is not None and options.model is not None:
        cases.append(_real(options.data, options.model))
    if options.sim_model is not None:
        cases.append(_simulated(options.sim_model, options.tip))
    if not cases:
        parser.error("give --data and --model, or --sim-model")
    lines: list[str] = []
    for case in cases:
        columns = ("images", "", "z", "alpha", "beta", "x", "y", "gamma", "NLL", "NEES", "95 %", "in range")
        lines += ["", case.title, "", "| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
        print("\n".join(lines[-4:]), flush=True)
        for count in options.counts:
            for row in _rows(case, count, options.seeds):
                lines.append("| " + " | ".join(row) + " |")
                print(lines[-1], flush=True)
            if count >= len(case.contacts.frames):
                lines.append("| " + " | ".join(_nearly_all(case)) + " |")
                print(lines[-1], flush=True)
    (out / "adapt.md").write_text("\n".join(lines).lstrip() + "\n", encoding="utf-8")


def _rows(case: Case, count: int, seeds: int) -> list[list[str]]:
    """Return a row of mean results of the adapted models, and rows of the candidates' errors on left-out contacts."""
    total = len(case.contacts.frames)
    measured: list[list[float]] = []
    left_out: dict[str, list[Array]] = {}
    methods = []
    for seed in range(seeds if count < total else 1):
        order = np.random.default_rng(seed).permutation(total)
        given, held_out = order[:count], order[max(count, total // 2) :]
        try:
            adapted = adapt_to(case.model, case.some(given), preprocessing=case.preprocessing, size=case.size)
        except TrainingError as error:
            methods.append(f"refused: {error}")
            continue
        methods.append(adapted.method)
        for name, errors in adapted.left_out_mae.items():
            left_out.setdefault(name, []).append(errors)
        if len(held_out):
            scores = predicted(adapted.model, case.some(held_out))
            coverage = 100.0 * float(np.mean(list(scores.coverage(0.95).values())))
            others = [float(scores.nll.mean()), float(scores.nees.mean()), coverage, 100.0 * scores.in_range.mean()]
            measured.append([*scores.mae().values(), *others])
    rows = []
    if measured:
        mean = np.mean(measured, axis=0)
        figures = [f"{value:.3f}" for value in mean[:6]] + [f"{value:.2f}" for value in mean[6:]]
        rows.append([str(count), f"adapted ({', '.join(sorted(set(methods)))}), {len(measured)} draws", *figures])
    for name, several in left_out.items():
        mae = np.mean(several, axis=0)[[2, 3, 4, 0, 1, 5]]
        rows.append([str(count), f"left out: {name}", *(f"{value:.3f}" for value in mae), "", "", "", ""])
    return rows or [[str(count), methods[-1], *[""] * 10]]


def _nearly_all(case: Case) -> list[str]:
    """Return a row of the errors of processes fitted to nine tenths of the contacts, on the tenths left out."""
    architecture = case.model.header.architecture
    assert isinstance(architecture, MarkerArchitecture)
    _, displacements, matched = align_camera(case.model, case.contacts)
    displacements, contacts = displacements[matched], contact_from_xi(case.contacts.xi)[matched]
    bank = case.model.tensors["bank"].astype(np.float64)
    moves = displacement_model_of(case.model)
    old = old_sensor(layers_of(case.model), case.model.header.labels, moves, bank, architecture.rings)
    outputs, _ = old.outputs(displacements)
    part = np.random.default_rng(0).permutation(np.arange(len(contacts)) % _PARTS)
    off = np.empty(contacts.shape)
    fewest = len(contacts)
    for left in (part == i for i in range(_PARTS)):
        fewest = min(fewest, int((~left).sum()))
        fitted = fit_transfer(old, outputs[~left], displacements[~left], contacts[~left])
        off[left] = fitted(outputs[left], displacements[left])[0] - contacts[left]
    mae = np.abs(off).mean(axis=0)[[2, 3, 4, 0, 1, 5]]
    title = f"transfer alone, fitted to {fewest} or more, on the tenth left out of each fit"
    return [f"all {len(contacts)} matched", title, *(f"{value:.3f}" for value in mae), "", "", "", ""]


def predicted(model: Model, contacts: LabelledDiscs) -> Scores:
    """Return the scores of a marker model on discs."""
    estimator = MarkerEstimator(model)
    camera = model.header.camera
    predictions: list[Prediction] = []
    for discs in contacts.frames:
        seen = discs if camera is None else Discs(camera.points(discs.centres), discs.areas)
        field = estimator.match(seen)
        predictions.append(estimator.decode(field, *estimator.infer(field)))
    return Scores.of(contact_from_xi(contacts.xi), predictions)


def _real(data: Path, path: Path) -> Case:
    split = read_split(data, "train")
    images = [read_image(image) for image in split.images]
    preprocessing = preprocessing_for(images[0])
    size = typical_size(preprocessing.reduce(images[0]))
    frames = [detect_markers(preprocessing.reduce(image), size) for image in images]
    contacts = LabelledDiscs(frames, xi_from_contact(split.contact_mm_deg))
    return Case(f"a second real sensor, {len(images)} images", load_model(path), contacts, preprocessing, size)


def _simulated(path: Path, tip: str) -> Case:
    model = load_model(path)
    architecture = model.header.architecture
    if not isinstance(architecture, MarkerArchitecture):
        raise SystemExit(f"{path} is not a marker model")
    sensor = load_tip(tip)
    other_tip, other_rig = second_sensor(sensor.tip, sensor.rig)
    drawn = _drawn(other_tip, other_rig, _DRAWN, 11, model)
    title = "a simulated sensor with another camera, mount, stiffness, skin and grip"
    return Case(title, model, drawn, model.header.preprocessing, architecture.size)


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
