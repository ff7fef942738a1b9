"""Tracking of a moving plate with each surface model, with Gaussian errors or the simulated camera and a network."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import TypeAdapter

from touchcell.cell.analysis.report import summarise
from touchcell.cell.analysis.run_data import load_run
from touchcell.cell.config.armed import REQUIRED_OF_ARMS, REQUIRED_OF_SENSORS
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.geometry import gaussian, se3
from touchcell.geometry.types import Array
from touchcell.perception.models.labels import CONTACT_NAMES, XI_UNITS
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.filter_spec import ContactFilter, FilterSection
from touchcell.perception.runtime.motion import PoseHistory
from touchcell.perception.runtime.pipeline import ContactSource

SENSOR_SIGMA = np.array([0.1, 0.1, 0.1, 0.9, 0.9, 0.35]) * XI_UNITS
"""Standard deviations of xi: similar to the shipped network's errors on its simulated validation images."""

_FRAME_NS = 33_333_333
_DEEPEST_MM = 15.0
_NOTHING = dict.fromkeys(CONTACT_NAMES, math.nan)

_ACCELERATION = {"accel_mm_s_per_sqrt_s": 15.0, "accel_deg_s_per_sqrt_s": 4.0, "speed_mm_s": 30.0, "speed_deg_s": 5.0}

FILTERS: dict[str, Mapping[str, Any] | None] = {
    "single frame": None,
    "still, drift 1.5": {"drift_mm_per_sqrt_s": 1.5, "drift_deg_per_sqrt_s": 1.5},
    "still, drift 4": {"drift_mm_per_sqrt_s": 4.0, "drift_deg_per_sqrt_s": 4.0},
    "still, drift 12": {"drift_mm_per_sqrt_s": 12.0, "drift_deg_per_sqrt_s": 12.0},
    "moving": {
        "model": "moving_surface",
        "drift_mm_per_sqrt_s": 0.5,
        "drift_deg_per_sqrt_s": 0.5,
        **_ACCELERATION,
    },
}


class GaussianContact(ContactSource):
    """A ``ContactSource`` in place of camera and network: the true contact with Gaussian errors, a cycle late.

    Args:
        truth: returns the true contact.
        pose_filter: None treats each frame independently.
        seed: of the errors.
    """

    def __init__(self, truth: ContactSource, pose_filter: ContactFilter | None, seed: int) -> None:
        self._truth = truth
        self._filter = pose_filter
        self._rng = np.random.default_rng(seed)
        self._poses = PoseHistory()
        self._captured: ContactEstimate | None = None
        self._newest: ContactEstimate | None = None
        self._seq = -1

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        self._poses.record(t_ns, T_base_sensor)

    def update(self, now_ns: int) -> ContactEstimate | None:
        if self._captured is not None:
            self._newest = self._estimate(self._captured)
            self._captured = None
        if now_ns // _FRAME_NS > self._seq:
            self._seq = now_ns // _FRAME_NS
            self._captured = self._truth.update(now_ns)
            if self._newest is None and self._captured is not None:
                # A run begins with a frame, as after the activation of a camera.
                self._newest = self._estimate(self._captured)
        newest = self._newest
        if self._filter is None or newest is None or newest.belief is None:
            return newest
        belief = self._filter.predict(self._poses.at(now_ns), now_ns)
        return ContactEstimate(True, belief, newest.t_frame_ns, newest.seq, now_ns, nis=newest.nis)

    def _estimate(self, true: ContactEstimate) -> ContactEstimate:
        t_ns = true.t_frame_ns
        if true.belief is None:
            if self._filter is not None:
                self._filter.reset()
            return ContactEstimate(False, None, t_ns, self._seq, t_ns)
        xi = se3.log(true.belief.mean) + SENSOR_SIGMA * self._rng.normal(size=6)
        belief, nis = gaussian.from_exponential(xi, np.diag(SENSOR_SIGMA**2)), None
        if self._filter is not None:
            state = self._filter.update(belief, self._poses.at(t_ns), t_ns)
            belief, nis = state.belief, state.nis
        return ContactEstimate(True, belief, t_ns, self._seq, t_ns, nis=nis)


def track(name: str, *, moving: bool, duration_s: float, seed: int, network: Path | None = None) -> dict[str, Any]:
    """Run the shipped tracking cell with one of ``FILTERS``.

    Args:
        name: of the filter.
        moving: True for a moving plate, False for a static one.
        duration_s: of the task.
        seed: of the sensor's errors.
        network: model for the simulated camera's images, in place of the sensor with Gaussian errors.

    Returns:
        ``outcome``, and RMS errors of ``estimation`` (estimate - true) and ``control`` (true - reference), mm and deg.
    """
    cell_file = yaml.safe_load(find_cell(Path("configs/object_track_sim.yaml")).read_text())
    cell_file["task"]["duration_s"] = duration_s
    # Interlocks on estimates and motion would end the runs of the worse filters, which are measured too.
    cell_file["interlocks"] = {
        k: v for k, v in cell_file["interlocks"].items() if v["kind"] in REQUIRED_OF_ARMS + REQUIRED_OF_SENSORS
    }
    cell_file["interlocks"]["indentation"]["limit_mm"] = _DEEPEST_MM
    if not moving:
        del cell_file["scene"]["surfaces"]["plate"]["motion"]
    settings = FILTERS[name]
    estimator = cell_file["sensors"]["sensor"]["estimator"]
    if network is not None:
        estimator |= {"model": str(network), "filter": None if settings is None else dict(settings)}
    else:
        put_on_true_contact(cell_file)
    pose_filter = None if settings is None else TypeAdapter(FilterSection).validate_python(settings).build()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(cell_file))
        cell = compose(plan_cell(path))
        sensor = cell.sensors["sensor"]
        if network is None:
            assert sensor.truth is not None
            sensor.source = GaussianContact(sensor.truth, pose_filter, seed)
        with Recorder(Path(folder) / "run.mcap") as recorder, cell:
            result = RunLoop(cell, recorder).run()
        errors = summarise(load_run(Path(folder) / "run.mcap"))["errors"]["sensor"]
    return {
        "filter": name,
        "plate": "moving" if moving else "still",
        "outcome": result.outcome.value,
        **{what: errors[what]["rms"] if what in errors else _NOTHING for what in ("estimation", "control")},
    }
