"""Whether ``inconsistent`` leaves good contacts alone and finds bad ones: minutes of contact in cells and sequences.

The cells are the shipped ones for following and tracking, with the filter that they name. ``slip_aware`` is for
contacts that count from first touch on a surface that stands still, and these cells refuse it: it gets the sequences of
``benchmarks.filter_slips``, as they are, and as a camera sees them that is mounted turned or mirrored.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.filter_slips import Observed, simulated
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Progress
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import CellView, SensorView
from touchcell.control.interlocks.timers import TimedInterlock
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.paths import CONFIGS
from touchcell.perception.runtime.slip_aware import SlipAwareConfig

RULE: Final = {"kind": "inconsistent", "limit_nis": 22.5, "frames": 5}
"""As in every shipped cell."""
_SEQUENCE_S: Final = 20.0
_TURNED: Final = np.diag([-1.0, -1.0, 1.0])
_MIRRORED: Final = np.diag([1.0, -1.0, 1.0])


@dataclass
class Watched:
    """What the rule saw of a kind of contact.

    Attributes:
        runs: of the cell, or sequences.
        contact_s: time in contact.
        nis: of every frame.
        trips: of ``inconsistent``.
        other: reasons of runs that ended as anything but done, without those trips.
        longest: consecutive frames beyond the limit.
        after: frames until each trip.
    """

    runs: int = 0
    contact_s: float = 0.0
    nis: list[float] = field(default_factory=list)
    trips: int = 0
    other: list[str] = field(default_factory=list)
    longest: int = 0
    after: list[int] = field(default_factory=list)

    def row(self, name: str) -> str:
        """Return the line of the table."""
        median, high = np.quantile(self.nis, [0.5, 0.99]) if self.nis else (np.nan, np.nan)
        beyond = sum(nis > RULE["limit_nis"] for nis in self.nis)  # type: ignore[operator]
        after = f"{np.median(self.after):.0f}, {max(self.after)}" if self.after else "-"
        return (
            f"{name:<46}{self.runs:>5}{self.contact_s / 60.0:>9.1f}{len(self.nis):>8}{median:>7.1f}{high:>8.1f}"
            f"{beyond:>7}{self.longest:>9}{self.trips:>7}{after:>12}"
        )


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``false_trips.txt`` and ``.json`` into ``out``."""
    parser = argparse.ArgumentParser("python -m benchmarks false-trips", description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of contact of each kind")
    options = parser.parse_args(arguments)
    found = {
        "following, stick_slip": _followed(60.0 * options.minutes),
        "tracking, stick_slip": _tracked(60.0 * options.minutes),
    }
    good = simulated(max(2, round(60.0 * options.minutes / _SEQUENCE_S)), 0)
    for name, seen in (("as it is", None), ("camera turned by 180 deg", _TURNED), ("camera mirrored", _MIRRORED)):
        found[f"sequences, slip_aware, {name}"] = _sequences(good, seen)
    lines = [
        f"{'':<46}{'runs':>5}{'minutes':>9}{'frames':>8}{'NIS':>7}{'99 %':>8}{'beyond':>7}{'in a row':>9}{'trips':>7}"
        f"{'after':>12}",
        *(each.row(name) for name, each in found.items()),
        "NIS: median and 99 %; beyond: frames whose NIS exceeds 22.5, the limit; in a row: most of them, five trip;",
        "after: frames until a trip, median and most; a sequence that has tripped ends",
        *(f"{name}: {reason}" for name, each in found.items() for reason in each.other),
    ]
    print("\n".join(lines))
    out.mkdir(parents=True, exist_ok=True)
    (out / "false_trips.txt").write_text("\n".join(lines) + "\n")
    (out / "false_trips.json").write_text(
        json.dumps({**provenance(), "rows": {name: each.row(name) for name, each in found.items()}}, indent=1) + "\n"
    )


def _followed(contact_s: float) -> Watched:
    """Follow the ramp again and again, each time with other noise."""
    watched = Watched()
    while watched.contact_s < contact_s:
        _run("surface_follow_sim.yaml", {"seed": watched.runs + 1}, watched)
    return watched


def _tracked(contact_s: float) -> Watched:
    watched = Watched()
    _run("object_track_sim.yaml", {"task.duration_s": contact_s}, watched)
    return watched


def _run(cell: str, settings: Mapping[str, Any], watched: Watched) -> None:
    plan = plan_cell(CONFIGS / cell, settings=settings)
    assert plan.cell.interlocks["inconsistent"].model_dump(include=set(RULE)) == RULE
    seen: dict[str, int] = {}
    times, nis = [], []

    def look(progress: Progress) -> None:
        for role, contact in progress.contacts.items():
            if seen.get(role) != contact.seq and contact.nis is not None:
                times.append(progress.t_s)
                nis.append(contact.nis)
            seen[role] = contact.seq

    with compose(plan) as composed:
        result = RunLoop(composed, None, on_cycle=look).run()
    watched.runs += 1
    watched.contact_s += times[-1] - times[0] if times else 0.0
    _count(nis, watched)
    if result.reason.startswith("inconsistent"):
        watched.trips += 1
    elif result.outcome.value != "done":
        watched.other.append(f"{result.outcome.value}: {result.reason}")


def _sequences(observed: Iterable[Observed], seen: Array | None) -> Watched:
    watched = Watched()
    for sequence in observed:
        watched.runs += 1
        nis, tripped = [], False
        (rule,) = build_interlocks(parse_interlocks({"inconsistent": RULE}), {})
        assert isinstance(rule, TimedInterlock)
        past: Any = {}
        for view in _views(sequence, seen):
            violation, past = rule.evaluate(view, past)
            watched.contact_s += sequence.period_s
            nis += [sensor.nis for sensor in view.sensors.values() if sensor.nis is not None]
            if violation is not None:
                tripped = True
                watched.after.append(len(nis))
                break
        watched.trips += tripped
        _count(nis, watched)
    return watched


def _views(sequence: Observed, seen: Array | None) -> Iterator[CellView]:
    contact_filter = SlipAwareConfig(model="slip_aware").build()
    for k, frame in enumerate(sequence.frames):
        if frame is None:
            continue
        t_ns = round(1e9 * k * sequence.period_s)
        nis = contact_filter.update(frame if seen is None else _seen(frame, seen), sequence.T_f_s[k], t_ns).nis
        yield CellView(t_ns, {}, {"sensor": SensorView(t_ns, k, True, 0.003, nis=nis)}, "run")


def _seen(frame: PoseGaussian, axes: Array) -> PoseGaussian:
    """Return a contact as a camera sees it whose image is turned or mirrored by ``axes`` (3, 3)."""
    T = np.eye(4)
    T[:3, :3] = axes
    twist = np.zeros((6, 6))
    twist[:3, :3], twist[3:, 3:] = axes, np.linalg.det(axes) * axes
    return PoseGaussian(T @ frame.mean @ T, twist @ frame.covariance @ twist.T)


def _count(nis: Sequence[float], watched: Watched) -> None:
    watched.nis += nis
    row = 0
    for value in nis:
        row = row + 1 if value > RULE["limit_nis"] else 0  # type: ignore[operator]
        watched.longest = max(watched.longest, row)
