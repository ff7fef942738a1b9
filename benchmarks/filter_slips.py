"""Filters on contacts that move and slip: what a frame, and a filter of frames, errs by from where the sensor is.

Simulated sequences (``touchcell.simulation.sequences``), whose friction differs from that of the sensor that the
estimator was trained on, as surfaces do; or collected ones (``data_collection`` with ``motions: sequence``).

The estimator of the simulated ones is a marker model, trained on single contacts that were pressed and then sheared and
whose labels are the motions of the arm, as on a bench. It sees the markers without images.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.filter_rivals import StudentFilter
from touchcell.drivers.replay.dataset import natural_order, read_split
from touchcell.geometry import gaussian, se3
from touchcell.geometry.gaussian import PoseGaussian, mahalanobis_squared
from touchcell.geometry.types import Array
from touchcell.perception.contact_poses import random_poses
from touchcell.perception.markers.detection import Discs
from touchcell.perception.markers.estimator import MarkerEstimator
from touchcell.perception.models.marker_architecture import MarkerSize
from touchcell.perception.models.preprocessing import Preprocessing
from touchcell.perception.runtime.estimators import load_estimator
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.filter_spec import ContactFilter
from touchcell.perception.runtime.slip_aware import SlipAwareConfig
from touchcell.perception.runtime.stick_slip import StickSlipFilter
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.sequences import random_sequence
from touchcell.simulation.tip import Tip
from touchcell.simulation.tip_file import load_tip

_FRAME: Final = (480, 640)
_LAW: Final = ContactLaw(torsion_grip=0.1)
_MARKER_PX: Final = 0.3
_SAMPLES: Final = 4000
_EPOCHS: Final = 25
_FRAMES: Final = 300
_RATES_HZ: Final = (30.0, 10.0)

FILTERS: Final[Mapping[str, Callable[[], ContactFilter] | None]] = {
    "single frame": None,
    "still": lambda: PoseFilter(isotropic_noise(1.5e-3, np.deg2rad(6.0))),
    "still, little drift": lambda: PoseFilter(isotropic_noise(0.05e-3, np.deg2rad(0.2))),
    "Student-t, little drift": lambda: StudentFilter(isotropic_noise(0.05e-3, np.deg2rad(0.2))),
    "stick-slip": lambda: StickSlipFilter(isotropic_noise(0.5e-3, np.deg2rad(2.0)), 0.5),
    "slip-aware": lambda: SlipAwareConfig(model="slip_aware").build(),
}


@dataclass(frozen=True)
class Observed:
    """A contact, frame by frame.

    Attributes:
        T_f_s: (n, 4, 4) where the sensor is, from the surface frame of first touch.
        frames: (n) estimates, None where a frame was refused.
        slipping: (n,) whether the skin slips, None where nothing says so.
        period_s: time between frames.
    """

    T_f_s: Array
    frames: tuple[PoseGaussian | None, ...]
    slipping: NDArray[np.bool_] | None
    period_s: float


def simulated(sequences: int, seed: int) -> list[Observed]:
    """Train an estimator on single contacts, and put sequences of other frictions through it."""
    tip, rng = Tip(load_tip("franka_tactip_1").tip), np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        estimator = _trained(tip, Path(folder) / "single.safetensors", rng)
    found = []
    for number in range(sequences):
        law = ContactLaw(
            slip_at_1mm_m=_LAW.slip_at_1mm_m * rng.uniform(0.6, 1.5),
            torsion_grip=_LAW.torsion_grip * rng.uniform(0.6, 1.5),
        )
        rate_hz = _RATES_HZ[number % len(_RATES_HZ)]
        sequence = random_sequence(_FRAMES, 1000 * seed + number, law, rate_hz=rate_hz)
        frames = []
        for pixels in tip.pixels(sequence.held):
            field = estimator.match(_discs(tip, pixels + rng.normal(0.0, _MARKER_PX, pixels.shape)))
            prediction = estimator.decode(field, *estimator.infer(field))
            usable = prediction.in_range
            frames.append(gaussian.from_exponential(prediction.xi, prediction.covariance) if usable else None)
        found.append(Observed(sequence.T_f_s, tuple(frames), sequence.slipping, 1.0 / rate_hz))
    return found


def collected(data: Path, split: str, model: Path, frame_hz: float) -> list[Observed]:
    """Return the sequences of a data set, each from the air into contact; none of contacts that were pressed singly.

    Raises:
        DataError, ModelError, ImageError: the data set or the model cannot be used.
    """
    labelled = read_split(data, split)
    order = sorted(range(len(labelled.images)), key=lambda i: natural_order(labelled.images[i]))
    T_f_s = se3.from_euler_mm_deg(labelled.contact_mm_deg[order])
    touching = T_f_s[:, 2, 3] > 0.0
    if touching.all():
        return []
    estimator = load_estimator(model)
    predictions = [estimator.predict(image) for image in labelled.read()]
    found = []
    for part in np.split(np.arange(len(order)), np.flatnonzero(np.diff(touching.astype(int))) + 1):
        if len(part) < 2 or not touching[part[0]]:
            continue
        chosen = [predictions[order[i]] for i in part]
        frames = [gaussian.from_exponential(p.xi, p.covariance) if p.in_range else None for p in chosen]
        found.append(Observed(T_f_s[part], tuple(frames), None, 1.0 / frame_hz))
    return found


def compare(sequences: list[Observed]) -> list[dict[str, Any]]:
    """Return a row for each filter: RMS errors mm and deg while slipping and sticking, NEES, and time per frame."""
    return list(_rows(sequences))


def show(rows: list[dict[str, Any]]) -> None:
    """Print the rows."""
    names = ("x_mm", "y_mm", "z_mm", "alpha_deg", "beta_deg", "gamma_deg")
    print(f"\n{'RMS, from the sensor':<26}{'skin':<10}" + "".join(f"{name:>11}" for name in names), end="")
    print("   NEES, median    us")
    for row in rows:
        for skin, rms in row["rms"].items():
            cells = "".join(f"{value:11.3f}" for value in rms)
            print(f"{row['filter']:<26}{skin:<10}{cells}{row['nees']:9.1f}{row['nees_median']:7.1f}{row['us']:6.0f}")


def _rows(sequences: list[Observed]) -> Iterator[dict[str, Any]]:
    slips = [sequence.slipping for sequence in sequences]
    for name, make in FILTERS.items():
        errors, nees, busy_s = [], [], 0.0
        for sequence in sequences:
            contact_filter = None if make is None else make()
            beliefs, seconds = _filtered(sequence, contact_filter)
            busy_s += seconds
            means = np.stack([belief.mean for belief in beliefs])
            errors.append(se3.to_euler_mm_deg(se3.inverse(means)) - se3.to_euler_mm_deg(sequence.T_f_s))
            true = se3.inverse(sequence.T_f_s)
            nees += [mahalanobis_squared(belief, T) for belief, T in zip(beliefs, true, strict=True)]
        error = np.concatenate(errors)
        parts = {"all": np.ones(len(error), dtype=np.bool_)}
        if all(each is not None for each in slips):
            slipping = np.concatenate([each for each in slips if each is not None])
            parts = {"slipping": slipping, "sticking": ~slipping}
        yield {
            "filter": name,
            "rms": {skin: np.sqrt((error[chosen] ** 2).mean(axis=0)).tolist() for skin, chosen in parts.items()},
            "nees": float(np.mean(nees)),
            "nees_median": float(np.median(nees)),
            "us": 1e6 * busy_s / len(error),
        }


def _filtered(sequence: Observed, contact_filter: ContactFilter | None) -> tuple[list[PoseGaussian], float]:
    """Return the estimate of each frame, and the CPU time of the filter. A refused frame is bridged."""
    beliefs: list[PoseGaussian] = []
    busy_s, filtering = 0.0, False
    for k, frame in enumerate(sequence.frames):
        begun = time.thread_time()
        at = sequence.T_f_s[k], round(1e9 * k * sequence.period_s)
        belief = frame
        if contact_filter is not None and frame is not None:
            belief, filtering = contact_filter.update(frame, *at).belief, True
        elif contact_filter is not None and filtering:
            belief = contact_filter.predict(*at)
        busy_s += time.thread_time() - begun
        beliefs.append(belief or (beliefs[-1] if beliefs else _nothing()))
    return beliefs, busy_s


def _nothing() -> PoseGaussian:
    """What is known of a contact before its first usable frame: that it is light."""
    return PoseGaussian(np.eye(4), np.diag([1e-6] * 3 + [1e-2] * 3))


def _discs(tip: Tip, pixels: Array) -> Discs:
    return Discs(pixels, np.full(len(pixels), np.pi * tip.parameters.disc_radius_px**2))


def _trained(tip: Tip, out: Path, rng: np.random.Generator) -> MarkerEstimator:
    from touchcell.perception.networks.marker_learning import KnownMarkers
    from touchcell.perception.networks.marker_training import LabelledDiscs, MarkerSettings, train_on_discs

    reference = tip.project(tip.rest_positions)

    def single_contacts(samples: int) -> LabelledDiscs:
        commanded = random_poses(samples, rng)
        held = np.stack([contact_at(T, _LAW).T_f_s for T in commanded])
        pixels = tip.pixels(held)
        pixels += rng.normal(0.0, _MARKER_PX, pixels.shape)
        known = KnownMarkers(reference, pixels - reference, np.ones(pixels.shape[:2], dtype=np.bool_))
        frames = [_discs(tip, each) for each in pixels]
        return LabelledDiscs(frames, se3.log(se3.inverse(commanded)), known)

    train_on_discs(
        single_contacts(_SAMPLES),
        single_contacts(_SAMPLES // 5),
        out,
        preprocessing=Preprocessing(input_size=_FRAME, output_size=_FRAME),
        size=MarkerSize.of_disc(np.pi * tip.parameters.disc_radius_px**2),
        settings=MarkerSettings(epochs=_EPOCHS, networks=1, hidden=(256, 256)),
        resume=False,
    )
    return MarkerEstimator.load(out)
