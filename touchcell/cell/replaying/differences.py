"""Where a replay differs from its run: estimates, twists, states of the task, violations, and how it ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from touchcell.cell.replaying.recorded_run import RecordedCycle, Row, numbers, pose_of
from touchcell.cell.replaying.replay import Replay
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_TO_MM_DEG = np.array([1e3] * 3 + [180 / np.pi] * 3)


@dataclass(frozen=True)
class Tolerance:
    """How far a replay may be from its run.

    Attributes:
        contact: of contact poses, mm and degrees.
        twist: of twists as sent, mm/s and deg/s.
    """

    contact: float = 0.5
    twist: float = 5.0


@dataclass(frozen=True)
class Difference:
    """Comparison of one kind of thing over all cycles.

    Attributes:
        what: "contact of sensor", "twist of arm", "state of the task", "violations".
        t_s: (n,) times since the first cycle that were compared.
        linear, angular: (n,) absolute differences, mm and degrees, of contacts, mm/s and deg/s of twists; empty for
            others.
        others: texts of the times at which something is in only one of both, or differs.
        tolerance: of linear and angular; NaN where there is none.
    """

    what: str
    t_s: Array
    linear: Array
    angular: Array
    others: tuple[str, ...]
    tolerance: float

    @property
    def units(self) -> tuple[str, str]:
        """Units of linear and angular."""
        return ("mm/s", "deg/s") if self.what.startswith("twist") else ("mm", "deg")

    @property
    def agrees(self) -> bool:
        """Whether the replay is as the run was, within tolerance."""
        return not self.others and not len(self.beyond)

    @property
    def beyond(self) -> Array:
        """Times (k,) at which the difference exceeds its tolerance."""
        if not len(self.linear):
            return np.zeros(0)
        off: Array = self.t_s[np.maximum(self.linear, self.angular) > self.tolerance]
        return off

    def __str__(self) -> str:
        mm, deg = self.units
        parts = []
        if len(self.linear):
            parts.append(
                f"{len(self.linear)} cycles, RMS {_rms(self.linear):.3g} {mm} and {_rms(self.angular):.3g} {deg}, "
                f"at most {self.linear.max():.3g} and {self.angular.max():.3g}"
            )
        if len(beyond := self.beyond):
            parts.append(f"{len(beyond)} beyond {self.tolerance:g}, first at {beyond[0]:.2f} s")
        if self.others:
            parts.append(f"{len(self.others)} unlike, first {self.others[0]}")
        return f"{self.what}: {'; '.join(parts) or 'the same'}"


def differences(replay: Replay, tolerance: Tolerance) -> list[Difference]:
    """Compare a replay with its run, cycle by cycle."""
    pairs = list(zip(replay.recorded.cycles, replay.replayed.cycles, strict=False))
    start_ns = pairs[0][0].now_ns
    t_s = [1e-9 * (was.now_ns - start_ns) for was, _ in pairs]
    contacts = [
        _compared(
            f"contact of {role}",
            t_s,
            [(was.contacts.get(role), now.contacts.get(role)) for was, now in pairs],
            _contact,
            tolerance.contact,
        )
        for role in sorted(replay.plan.sensor_roles)
    ]
    twists = [
        _compared(
            f"twist of {role}",
            t_s,
            [(was.commands.get(role), now.commands.get(role)) for was, now in pairs],
            _twist,
            tolerance.twist,
        )
        for role in sorted({role for cycles in pairs for cycle in cycles for role in cycle.commands})
    ]
    states = _of_texts("state of the task", t_s, [(was.task_state, now.task_state) for was, now in pairs])
    violations = _of_texts("violations", t_s, [(_names(was), _names(now)) for was, now in pairs])
    of, done = len(replay.recorded.cycles), len(replay.replayed.cycles)
    early = () if done == of else (f"after {done} of {of} cycles: {replay.result.reason}",)
    return [*contacts, *twists, states, violations, _without_numbers("end", early)]


def _compared(
    what: str,
    t_s: Sequence[float],
    pairs: Sequence[tuple[Row | None, Row | None]],
    apart: Callable[[Row, Row], tuple[float, float] | str | None],
    tolerance: float,
) -> Difference:
    """Compare two messages of each cycle; ``apart`` returns their distance, or what else is unlike."""
    times, values, others = [], [], []
    for t, (was, now) in zip(t_s, pairs, strict=True):
        if was is None and now is None:
            continue
        off = "only in the run" if now is None else "only in the replay" if was is None else apart(was, now)
        if isinstance(off, str):
            others.append(f"at {t:.2f} s: {off}")
        elif off is not None:
            times.append(t)
            values.append(off)
    array = np.array(values, dtype=np.float64).reshape(-1, 2)
    return Difference(what, np.array(times), array[:, 0], array[:, 1], tuple(others), tolerance)


def _of_texts(what: str, t_s: Sequence[float], pairs: Sequence[tuple[str, str]]) -> Difference:
    others = (
        f"at {t:.2f} s: {was or 'none'}, now {now or 'none'}"
        for t, (was, now) in zip(t_s, pairs, strict=True)
        if was != now
    )
    return _without_numbers(what, tuple(others))


def _without_numbers(what: str, others: tuple[str, ...]) -> Difference:
    none = np.zeros(0)
    return Difference(what, none, none, none, others, np.nan)


def _contact(was: Row, now: Row) -> tuple[float, float] | str | None:
    touched, touches = bool(was.get("in_contact")), bool(now.get("in_contact"))
    if touched != touches:
        return f"{_contact_name(touched)}, now {_contact_name(touches)}"
    T_was, T_now = pose_of(was), pose_of(now)
    if not (np.isfinite(T_was).all() and np.isfinite(T_now).all()):
        return None
    return _sizes(se3.log(se3.compose(se3.inverse(T_was), T_now)) * _TO_MM_DEG)


def _contact_name(touching: bool) -> str:
    return "in contact" if touching else "out of contact"


def _twist(was: Row, now: Row) -> tuple[float, float]:
    return _sizes((numbers(now.get("twist")) - numbers(was.get("twist"))) * _TO_MM_DEG)


def _sizes(difference: Array) -> tuple[float, float]:
    return float(np.linalg.norm(difference[:3])), float(np.linalg.norm(difference[3:]))


def _names(cycle: RecordedCycle) -> str:
    """Interlocks that were violated, and whom by, without the numbers in their reasons."""
    violations = () if cycle.verdict is None else cycle.verdict.get("violations", ())
    return ", ".join(sorted({":".join(str(each).split(":")[:2]) for each in violations}))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
