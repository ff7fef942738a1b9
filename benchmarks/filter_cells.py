"""Filters on the recordings of shipped cells: the same frames through each, compared at equal times.

A cell runs once with its own filter. Its frames, as the network measured them, then go through every filter with the
arm's recorded poses, and all are compared with the true contact: at the time of the frame, and predicted to times
between frames.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from touchcell.cell.analysis.run_data import Series
from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian, mahalanobis_squared
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.filter_spec import ContactFilter
from touchcell.perception.runtime.moving_surface import MovingSurfaceFilter
from touchcell.perception.runtime.stick_slip import StickSlipFilter

CELLS: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "follow ramp": ("surface_follow_sim.yaml", {}),
    "follow dome": ("surface_follow_dome_sim.yaml", {}),
    "track": ("object_track_sim.yaml", {}),
    "push, 20 mm/s": ("single_push_sim.yaml", {"task.push_speed_mm_s": 20.0}),
    "push": ("single_push_sim.yaml", {}),
    "push, two arms": ("dual_push_sim.yaml", {}),
}
_LATE_S: Final = (0.010, 0.027, 0.043)
"""Times after a frame at which its estimate is used, by latency and control cycles."""
_LOST_S: Final = 0.12
_TOLERANCE: Final = 1.02
_SI: Final = np.repeat([1e-3, np.pi / 180.0], 3)


def _still() -> ContactFilter:
    return PoseFilter(isotropic_noise(1.5e-3, np.deg2rad(6.0)))


def _moving() -> ContactFilter:
    return MovingSurfaceFilter(
        isotropic_noise(0.5e-3, np.deg2rad(0.5)),
        isotropic_noise(15e-3, np.deg2rad(4.0)),
        isotropic_noise(30e-3, np.deg2rad(5.0)),
    )


def _stick_slip() -> ContactFilter:
    return StickSlipFilter(isotropic_noise(0.5e-3, np.deg2rad(2.0)), 0.5)


FILTERS: Final[Mapping[str, Callable[[], ContactFilter] | None]] = {
    "single frame": None,
    "still": _still,
    "moving": _moving,
    "stick-slip": _stick_slip,
}
"""Settings of 0.1.0's cells for following and for pushing, and those of today's."""


@dataclass(frozen=True, slots=True)
class _Recorded:
    """Frames of one sensor while the task ran.

    Attributes:
        t_s: (n,) times of the frames.
        T_s_f, sigma: (n, 4, 4) and (n, 6) as the network measured them.
        inside: (n,) whether the task was in its run state.
        sensor, true: returns the sensor's pose and the true contact (4, 4) ``T_s_f`` at a time; None out of contact.
    """

    t_s: Array
    T_s_f: Array
    sigma: Array
    inside: NDArray[np.bool_]
    sensor: Callable[[float], Array]
    true: Callable[[float], Array | None]


def compare() -> list[dict[str, Any]]:
    """Return a row for each cell, sensor and filter: RMS errors, NEES, and components worse than a frame's."""
    rows: list[dict[str, Any]] = []
    for name, (cell, settings) in CELLS.items():
        with tempfile.TemporaryDirectory() as folder:
            run = _recording(cell, settings, Path(folder))
            for role in run.recording.roles("sensors", "measurement"):
                rows += _rows(name, role, _recorded(run, role))
    return rows


def show(rows: list[dict[str, Any]]) -> None:
    """Print the rows."""
    print("the same recordings through all filters; RMS at the time of the frame / between frames; mm and deg")
    print(f"{'cell, sensor':<34}{'filter':<13}" + "".join(f"{name:>16}" for name in COMPONENTS) + "   worse     NEES")
    for row in rows:
        cells = "".join(f"{a:8.3f} /{b:6.3f}" for a, b in zip(row["frame"], row["between"], strict=True))
        worse = f"{row['worse_frame']} / {row['worse_between']}"
        print(f"{row['cell'] + ', ' + row['sensor']:<34}{row['filter']:<13}{cells}   {worse:>5}{row['nees']:9.1f}")
    print("(worse: components more than 2 % worse than the single frame; NEES: 6 where a filter knows how sure it is)")


def _recording(cell: str, settings: Mapping[str, Any], folder: Path) -> RunFolder:
    plan = plan_cell(CONFIGS / cell, settings=settings)
    (folder / "cell.yaml").write_text(plan.text())
    composed = compose(plan)
    with Recorder(folder / "run.mcap") as recorder, composed:
        RunLoop(composed, recorder).run()
    return RunFolder(folder)


def _recorded(run: RunFolder, role: str) -> _Recorded:
    recording, plan = run.recording, run.plan
    measured, truth = recording.series(f"/sensors/{role}/measurement"), recording.series(f"/sensors/{role}/truth")
    section = plan.cell.sensors[plan.sensor_roles[role]]
    arm = next((each for each, name in plan.arm_roles.items() if name == section.mounted_on), section.mounted_on)
    tcp = recording.series(f"/arms/{arm}/tcp")
    assert measured is not None
    assert truth is not None
    assert tcp is not None
    poses, contacts = se3.from_euler_mm_deg(tcp.poses()) @ section.T_tcp_sensor, truth.poses()

    def true(t_s: float) -> Array | None:
        contact = contacts[_index(truth, t_s)]
        return se3.inverse(se3.from_euler_mm_deg(contact)) if np.isfinite(contact).all() else None

    return _Recorded(
        measured.t_s,
        se3.inverse(se3.from_euler_mm_deg(measured.poses())),
        np.column_stack([measured.column(f"sigma_{name}") for name in COMPONENTS]) * _SI,
        recording.during(measured.t_s, "run"),
        lambda t_s: np.asarray(poses[_index(tcp, t_s)]),
        true,
    )


def _index(series: Series, t_s: float) -> int:
    return int(np.clip(np.searchsorted(series.t_s, t_s + 1e-6, side="right") - 1, 0, len(series.t_s) - 1))


def _rows(cell: str, sensor: str, recorded: _Recorded) -> Iterator[dict[str, Any]]:
    reference: tuple[Array, Array] | None = None
    for name, make in FILTERS.items():
        frame, between, nees = _errors(recorded, None if make is None else make())
        reference = reference or (frame, between)
        yield {
            "cell": cell,
            "sensor": sensor,
            "filter": name,
            "frame": frame.tolist(),
            "between": between.tolist(),
            "nees": nees,
            "worse_frame": int((frame > _TOLERANCE * reference[0]).sum()),
            "worse_between": int((between > _TOLERANCE * reference[1]).sum()),
        }


def _errors(recorded: _Recorded, contact_filter: ContactFilter | None) -> tuple[Array, Array, float]:
    at_frame, between, nees = [], [], []
    last_s = -np.inf
    for k, t_s in enumerate(recorded.t_s):
        belief = PoseGaussian(recorded.T_s_f[k], np.diag(recorded.sigma[k] ** 2))
        if contact_filter is not None:
            if t_s - last_s > _LOST_S:
                contact_filter.reset()
            belief = contact_filter.update(belief, recorded.sensor(t_s), round(t_s * 1e9)).belief
        last_s, true = t_s, recorded.true(t_s)
        if not recorded.inside[k] or true is None:
            continue
        at_frame.append(_difference(belief.mean, true))
        nees.append(mahalanobis_squared(belief, true))
        for late_s in _LATE_S:
            later = t_s + late_s
            if (true := recorded.true(later)) is None:
                continue
            mean = belief.mean
            if contact_filter is not None:
                mean = contact_filter.predict(recorded.sensor(later), round(later * 1e9)).mean
            between.append(_difference(mean, true))
    return _rms(at_frame), _rms(between), float(np.mean(nees))


def _difference(T_s_f: Array, true: Array) -> Array:
    return np.asarray(se3.to_euler_mm_deg(se3.inverse(T_s_f)) - se3.to_euler_mm_deg(se3.inverse(true)))


def _rms(errors: list[Array]) -> Array:
    return np.asarray(np.sqrt(np.mean(np.square(errors), axis=0)))
