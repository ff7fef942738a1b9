"""``touchcell bench tuning``: gain margins and step responses of the controllers.

Each loop is closed around exact kinematics in control cycles of 10 ms: the contact is sampled at the frame rate and the
estimate comes ``latency`` later, held until the next one, without a filter that would predict over it. The gain margin
is the factor on all gains of a loop up to which its step response decays. The pushed object is that of the closed forms
(limit surface, sticking point), an 80 mm square.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from touchcell.cell.bench.provenance import provenance
from touchcell.control.alignment import TargetAlignment
from touchcell.control.servo import TactileServo
from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.simulation.objects import BoxShape
from touchcell.simulation.solids import friction_radius_m
from touchcell.tasks.contact_servo import ContactServoConfig
from touchcell.tasks.dual_arm_pushing import FollowerConfig
from touchcell.tasks.object_tracking import ObjectTrackingConfig
from touchcell.tasks.single_arm_pushing import PushConfig, SingleArmPushingConfig
from touchcell.tasks.surface_following import SurfaceFollowingConfig

PERIOD_S: Final = 0.01
FRAME_RATES_HZ: Final = (15.0, 30.0, 60.0)
LATENCIES_MS: Final = (0.0, 10.0, 30.0, 50.0)
NOMINAL: Final = (30.0, 10.0)
"""Frame rate (Hz) and latency (ms) of the shipped cells."""
_LARGEST: Final = 32.0
_AXES: Final = ("x", "y", "z", "alpha", "beta", "gamma")

Answer = Callable[[float, float, float], Array]
"""Maps gain factor, frame rate (Hz) and latency (ms) to the error at each cycle after a step of 1."""


@dataclass(frozen=True, slots=True)
class Line:
    """A loop and its gains.

    Attributes:
        name: controller and axis.
        gains: with units.
        answer: step response.
    """

    name: str
    gains: str
    answer: Answer


class _Frames:
    """Measurements of ``value``: sampled at the frame rate, delayed, held."""

    def __init__(self, frame_rate_hz: float, latency_ms: float) -> None:
        self._period_s = 1.0 / frame_rate_hz
        self._latency_s = 1e-3 * latency_ms
        self._taken: deque[tuple[float, Any]] = deque()
        self._next_s = 0.0
        self.newest: Any = None
        self.t_ns = -1

    def look(self, t_s: float, value: Any) -> bool:
        """Sample the truth at ``t_s``; return True if there is a new estimate."""
        if t_s >= self._next_s - 1e-9:
            self._taken.append((t_s, value))
            self._next_s += self._period_s
        new = False
        while self._taken and self._taken[0][0] + self._latency_s <= t_s + 1e-9:
            taken_s, self.newest = self._taken.popleft()
            self.t_ns, new = round(taken_s * 1e9), True
        return new


def servo_answer(config: ContactServoConfig, axis: int, duration_s: float = 4.0) -> Answer:
    """Return the response of one axis of a servo to a step of 1 mm or 1 deg."""
    unit = 1e-3 if axis < 3 else math.radians(1.0)

    def answer(factor: float, frame_rate_hz: float, latency_ms: float) -> Array:
        scaled = {name: tuple(factor * g for g in getattr(config, name)) for name in ("kp_per_s", "ki_per_s2", "kd")}
        wide = {"max_speed_mm_s": 1e6, "max_turn_deg_s": 1e6}
        wide |= {"max_integral_speed_mm_s": 1e6, "max_integral_turn_deg_s": 1e6}
        controller = TactileServo(np.eye(4), np.eye(4), config.model_copy(update=scaled | wide).gains(), PERIOD_S)
        start = np.zeros(6)
        start[axis] = -unit
        T_f_s, frames, errors = se3.exp(start), _Frames(frame_rate_hz, latency_ms), []
        for i in range(round(duration_s / PERIOD_S)):
            frames.look(i * PERIOD_S, se3.inverse(T_f_s))
            V = controller.step(frames.newest, frames.t_ns, np.zeros(6))
            T_f_s = se3.compose(T_f_s, se3.exp(V * PERIOD_S))
            errors.append(-float(se3.log(T_f_s)[axis]) / unit)
            if abs(errors[-1]) > 50.0:
                break
        return np.array(errors)

    return answer


def alignment_answer(config: PushConfig, duration_s: float = 20.0) -> Answer:
    """Return the cross-track error of a pushed square that starts 1 mm beside a straight path."""
    half_m = 0.04
    c = friction_radius_m(BoxShape(kind="box", size_mm=(80, 80, 60)).build())  # type: ignore[arg-type]
    turn_per_m = half_m / (half_m**2 + c**2)
    speed_m_s, lead_m = 1e-3 * config.push_speed_mm_s, 1e-3 * config.object_center_offset_mm

    def answer(factor: float, frame_rate_hz: float, latency_ms: float) -> Array:
        gains = config.model_copy(
            update={
                "align_kp_mm_s_per_deg": factor * config.align_kp_mm_s_per_deg,
                "align_kd_mm_per_deg": factor * config.align_kd_mm_per_deg,
                "align_max_mm_s": 1e6,
                "target_mm": (1e4, 0.0),
            }
        )
        alignment: TargetAlignment = gains.alignment()
        x, y, heading, left_m_s, asides = 0.0, 0.0, 0.0, 0.0, []
        frames = _Frames(frame_rate_hz, latency_ms)
        for i in range(round(duration_s / PERIOD_S)):
            cos, sin = math.cos(heading), math.sin(heading)
            tip = (x - lead_m * cos, y - lead_m * sin)
            T = np.array(
                [[0.0, -sin, cos, tip[0]], [0.0, cos, sin, tip[1]], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
            )
            if frames.look(i * PERIOD_S, T):
                aim = alignment.aim(frames.newest, np.eye(4))
                left_m_s = alignment.step(aim, PERIOD_S if frames.t_ns == 0 else 1.0 / frame_rate_hz)
            if i == 0:
                y = 1e-3
            heading -= turn_per_m * left_m_s * PERIOD_S
            x, y = x + speed_m_s * PERIOD_S * math.cos(heading), y + speed_m_s * PERIOD_S * math.sin(heading)
            asides.append(1e3 * y)
            if abs(asides[-1]) > 50.0:
                break
        return np.array(asides)

    return answer


def dies_away(errors: Array, cycles: int) -> bool:
    """Return True if the response covers all ``cycles`` and swings less in its second half than in its first."""
    if len(errors) < cycles:
        return False
    half = len(errors) // 2
    return float(np.ptp(errors[half:])) < 0.7 * float(np.ptp(errors[:half]))


def margin(answer: Answer, frame_rate_hz: float, latency_ms: float) -> float:
    """Return the largest factor on the gains with which the loop is stable; at most 32."""
    cycles = len(answer(1e-3, frame_rate_hz, latency_ms))
    low, high = 1e-3, 0.25
    while dies_away(answer(high, frame_rate_hz, latency_ms), cycles):
        low, high = high, 2.0 * high
        if low >= _LARGEST:
            return _LARGEST
    while high / low > 1.03:
        middle = math.sqrt(low * high)
        if dies_away(answer(middle, frame_rate_hz, latency_ms), cycles):
            low = middle
        else:
            high = middle
    return low


def settling(errors: Array) -> dict[str, float]:
    """Return the time to stay within 5 % (s) and the overshoot (%) of a step response."""
    outside = np.flatnonzero(np.abs(errors) > 0.05)
    overshoot = max(0.0, -float(errors.min()) / abs(float(errors[0])))
    return {
        "settling_s": float((outside[-1] + 1) * PERIOD_S) if len(outside) else 0.0,
        "overshoot_percent": 100.0 * overshoot,
    }


def lines() -> list[Line]:
    """Return the loops of the shipped tasks, with their default gains."""
    found = []
    for name, config, axes in (
        ("surface following", SurfaceFollowingConfig(), (2, 3)),
        ("object tracking", ObjectTrackingConfig(), (0, 2, 3)),
        ("follower", FollowerConfig(), (1, 2, 3)),
        ("leader", SingleArmPushingConfig(target_mm=(300.0, 0.0)), (3,)),
    ):
        assert isinstance(config, ContactServoConfig)
        for axis in axes:
            gains = f"kp {config.kp_per_s[axis]:g}/s, ki {config.ki_per_s2[axis]:g}/s2"
            found.append(Line(f"{name}, {_AXES[axis]}", gains, servo_answer(config, axis)))
    push = SingleArmPushingConfig(target_mm=(300.0, 0.0))
    gains = f"kp {push.align_kp_mm_s_per_deg:g} mm/s/deg, ki {push.align_ki_deg_per_mm_s:g} deg/mm/s"
    found.append(Line("target alignment", gains, alignment_answer(push)))
    return found


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the table; write ``tuning.json`` and ``tuning.png`` into ``out``."""
    heads = [f"{rate:g} Hz {late:g} ms" for rate in FRAME_RATES_HZ for late in LATENCIES_MS]
    print("gain margin (factor) by frame rate and latency; step at {:g} Hz, {:g} ms".format(*NOMINAL))
    print(f"{'loop':<24}{'gains':<36}{'settles s':>10}{'over %':>8}" + "".join(f"{head:>12}" for head in heads))
    rows: dict[str, dict[str, Any]] = {}
    answers: dict[str, Array] = {}
    for line in lines():
        answers[line.name] = line.answer(1.0, *NOMINAL)
        margins = {
            head: margin(line.answer, rate, late)
            for head, (rate, late) in zip(
                heads, [(rate, late) for rate in FRAME_RATES_HZ for late in LATENCIES_MS], strict=True
            )
        }
        rows[line.name] = {"gains": line.gains, **settling(answers[line.name]), "margins": margins}
        cells = "".join(f"{value:12.2f}" for value in margins.values())
        row = rows[line.name]
        print(
            f"{line.name:<22}{line.gains:<36}{row['settling_s']:10.2f}{row['overshoot_percent']:8.1f}{cells}",
            flush=True,
        )
    (out / "tuning.json").write_text(json.dumps({**provenance(), "loops": rows}, indent=1) + "\n")
    _plot(rows, answers, out / "tuning.png")


def _plot(rows: dict[str, dict[str, Any]], answers: dict[str, Array], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(13, 4.8), layout="constrained")
    for name, errors in answers.items():
        left.plot(PERIOD_S * np.arange(len(errors)), errors, label=name)
    left.set_xlim(0.0, 4.0)
    left.set_title("step response, {:g} Hz, {:g} ms".format(*NOMINAL))
    left.set_xlabel("s")
    left.set_ylabel("error / step")
    left.grid(alpha=0.3)
    left.legend(fontsize=8)
    for name, row in rows.items():
        right.plot(list(row["margins"]), list(row["margins"].values()), marker="o", label=name)
    right.axhline(1.0, color="k", lw=0.8)
    right.set_yscale("log", base=2)
    right.tick_params(axis="x", rotation=60, labelsize=8)
    right.set_title("gain margin (factor)")
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
