"""After first contact: a small known motion whose measured answer must agree with it before the arm servos.

A camera that is mounted turned or mirrored, or a model of another sensor, gives estimates that look like any others.
Servoing on them, the arm runs away: every correction enlarges the error. Only motion shows it. The sensor is pressed
on, then shifted and tilted by amounts that any surface bears, along one axis after the other, and the estimates of
single frames are regressed on the motion of the arm: answer = a motion + b conj(motion) + c + d t + e t^2, for shear
and tilt as complex numbers. While the sensor is shifted there and back it is tilted to either side: what shear does to
an estimate of tilt, as much as the tilt itself where a tip is touched 20 deg beside its axis, is told from its answer.
A right sensor has a near 1 and b near 0; the angle of a is that of a turned camera; in a mirror b takes its place. The
depth alone is the same however the camera is turned: it is held, so that a surface that rises or sinks is followed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from touchcell.geometry import se3
from touchcell.geometry.types import Array
from touchcell.perception.runtime.motion import PoseHistory

_FEWEST = 6
_LEAST_GAIN = 0.3
# Labels of data sets are the arm's motions before the contact slips: of a motion too small to slip, a network that has
# learnt them reports several times as much shear. How the sensor is tilted has no such excuse.
_MOST_GAIN = {"shear": 20.0, "tilt": 3.0}
# A surface that moves drags the contact until it slides, and its shear then answers to what drags it; the tilt does
# not slide. In 155 checks on plates in periodic motion, shear that was wrong answered with at most this share of its
# drift above the least gain.
_DRIFT_GAIN = {"shear": 0.2, "tilt": 0.0}
_SURE = 2.5
_MIRROR_RATIO = 2.0
_MOST_TURN_DEG = 30.0
_OPPOSITE_DEG = 90.0
_PRESS_SHARE = 0.075
_BACK_PER_S = 10.0
_BACK_PER_S2 = 25.0
_MOST_DRAG_M_S = 2e-3
_BACK_S = 0.2
_SHARES = (0.95, 0.75, 0.5, 0.25)
_BEHIND_M, _BEHIND_RAD = 0.1e-3, math.radians(0.2)
# By proportional control of a measurement that is a frame old and more.
_DEPTH_PER_S = 5.0
_MOST_FOLLOW_M_S = 10e-3


@dataclass(frozen=True)
class Answer:
    """Regression of a plane's measured motion on the arm's.

    Attributes:
        straight: complex gain ``a``.
        mirrored: complex gain ``b``.
        deviation: standard deviation of either.
        drift_ratio: how far the measured motion drifted by itself, over how far the arm moved.
    """

    straight: complex
    mirrored: complex
    deviation: float
    drift_ratio: float = 0.0

    def is_clear(self, drift_gain: float = 0.0) -> bool:
        """True if there is an answer beyond the noise, and beyond that share of the drift."""
        gain = max(abs(self.straight), abs(self.mirrored)) - drift_gain * self.drift_ratio
        return gain > max(_LEAST_GAIN, _SURE * self.deviation)

    @property
    def handedness(self) -> int:
        """1 if the answer is straight, -1 if it is that of a mirror, 0 if it may be either."""
        more = abs(self.straight) - abs(self.mirrored)
        return 0 if abs(more) <= _SURE * self.deviation else int(math.copysign(1.0, more))

    @property
    def is_mirror_alone(self) -> bool:
        """True if little but a mirror answers so.

        An object that turns with the sensor about one axis leaves the answer about the other: straight and mirrored
        parts are as large as each other then, and one that turns farther than the sensor makes the mirrored one larger.
        """
        return abs(self.mirrored) - _SURE * self.deviation > _MIRROR_RATIO * abs(self.straight)

    @property
    def turn_deg(self) -> float:
        """Angle of the measured motion from the arm's."""
        return math.degrees(math.atan2(self.straight.imag, self.straight.real))


class SensorCheck:
    """The motion of one sensor, and the judgement of its answer.

    Args:
        duration_s: of the motion.
        press_mm: depth that is added first, and kept.
        shift_mm: largest shear.
        tilt_deg: largest tilt.
        shears: whether a shift shows as shear in both directions; of an edge, which glides along with the sensor, it
            does not, and the tilt alone is judged.
    """

    def __init__(
        self, duration_s: float, *, press_mm: float, shift_mm: float, tilt_deg: float, shears: bool = True
    ) -> None:
        self._shears = shears
        self._duration_s = duration_s
        self._press_m, self._shift_m, self._tilt_rad = 1e-3 * press_mm, 1e-3 * shift_mm, math.radians(tilt_deg)
        self._poses = PoseHistory()
        self._frames: list[tuple[int, Array, Array]] = []
        self._seq = -1
        self._t_s = 0.0
        self._drag = np.zeros(3)
        self._begin_ns: int | None = None
        self._pressed_ns: int | None = None
        self._begin: Array | None = None
        self._surface_m: float | None = None
        self._held_m: float | None = None
        self._followed_m = 0.0
        self._follow_m_s = 0.0

    @property
    def finished(self) -> bool:
        """True if the motion is complete."""
        return self._t_s >= self._duration_s + _BACK_S

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """Record the sensor's pose."""
        self._poses.record(t_ns, T_base_sensor)
        self._begin_ns = t_ns if self._begin_ns is None else self._begin_ns
        if self._pressed_ns is None and self._t_s > _PRESS_SHARE * self._duration_s:
            self._pressed_ns = t_ns

    def record_contact(self, seq: int, t_ns: int, T_s_f: Array) -> None:
        """Record the contact pose of a frame, by itself; the same frame counts once, none from before the motion."""
        if seq == self._seq or self._begin is None or self._begin_ns is None or t_ns < self._begin_ns:
            return
        self._seq = seq
        T_base_sensor = self._poses.at(t_ns)
        self._follow_m_s = self._follow(t_ns, se3.compose(se3.inverse(self._begin), T_base_sensor), T_s_f)
        if self._pressed_ns is not None:
            self._frames.append((t_ns, T_base_sensor, T_s_f))

    def _follow(self, t_ns: int, T_begin_sensor: Array, T_s_f: Array) -> float:
        """Return the speed along z that holds the depth.

        Until a frame has come since the sensor was pressed on, only a surface that comes nearer is followed, by its
        place at the first frame: of a model that tells too little depth it would seem to recede.
        """
        surface_m = float(se3.compose(T_begin_sensor, T_s_f)[2, 3])
        self._surface_m = surface_m if self._surface_m is None else self._surface_m
        nearer_m = surface_m - self._surface_m - self._followed_m
        if self._pressed_ns is None or t_ns < self._pressed_ns:
            return _DEPTH_PER_S * min(nearer_m, 0.0)
        depth_m = float(se3.inverse(T_s_f)[2, 3])
        self._held_m = depth_m if self._held_m is None else self._held_m
        shallower_m = self._held_m - depth_m
        return _DEPTH_PER_S * (min(nearer_m, shallower_m) if nearer_m < 0.0 else shallower_m)

    def step(self, dt_s: float, T_base_sensor: Array) -> Array:
        """Advance by a cycle and return the sensor's twist (6,) in its own frame.

        Where the arm falls behind, as where an interlock slows it in one direction, the motion waits for it, so that
        the sensor moves as far as it should and ends where it began. A surface that moves drags a compliant arm along:
        that is integrated.
        """
        if self._begin is None:
            self._begin = T_base_sensor
        follow = np.zeros(6)
        follow[2] = np.clip(self._follow_m_s, -_MOST_FOLLOW_M_S, _MOST_FOLLOW_M_S)
        self._followed_m += dt_s * float(follow[2])
        start = se3.compose(self._begin, se3.exp([0.0, 0.0, self._followed_m, 0.0, 0.0, 0.0]))
        before = self._displacement(self._t_s)
        behind = se3.log(se3.compose(se3.inverse(T_base_sensor), se3.compose(start, se3.exp(before))))
        if np.linalg.norm(behind[:3]) < _BEHIND_M and np.linalg.norm(behind[3:]) < _BEHIND_RAD:
            self._t_s = min(self._t_s + dt_s, self._duration_s + _BACK_S)
        self._drag = np.clip(self._drag + dt_s * _BACK_PER_S2 * behind[:3], -_MOST_DRAG_M_S, _MOST_DRAG_M_S)
        twist: Array = follow + (self._displacement(self._t_s) - before) / dt_s + _BACK_PER_S * behind
        twist[:3] += self._drag
        return twist

    def verdict(self) -> str:
        """Return what is wrong with the sensor; empty if its answer agrees with the motion."""
        if len(self._frames) < _FEWEST:
            return f"the sensor gave {len(self._frames)} estimates during the check, {_FEWEST} are needed"
        answers = dict(zip(("shear", "tilt"), self.answers(), strict=True))
        if not self._shears:
            del answers["shear"]
        clear = {name: answer for name, answer in answers.items() if answer.is_clear(_DRIFT_GAIN[name])}
        if not clear:
            return f"another model: estimated {' and '.join(answers)} do not follow the arm"
        mirrored = [name for name, answer in clear.items() if answer.handedness < 0]
        if mirrored and not any(answer.handedness > 0 for answer in clear.values()):
            return f"camera mirrored: the estimated {mirrored[0]} moves as in a mirror when the arm moves"
        for name, answer in clear.items():
            if name in mirrored and answer.is_mirror_alone:
                return f"another model: the estimated {name} moves as in a mirror when the arm moves, the rest does not"
            if abs(answer.straight) - _SURE * answer.deviation > _MOST_GAIN[name]:
                return f"another model: the estimated {name} moves {abs(answer.straight):.1f} times as far as the arm"
        apart = [answer.turn_deg for answer in clear.values()]
        if abs((apart[0] - apart[-1] + 180.0) % 360.0 - 180.0) > _OPPOSITE_DEG:
            return f"another model: estimated shear is turned by {apart[0]:.0f} deg, tilt by {apart[-1]:.0f} deg"
        both = _pooled(list(clear.values()))
        # The standard deviation of the angle is that of the gain across, over the gain.
        unsure_deg = math.degrees(math.atan2(_SURE * both.deviation, abs(both.straight)))
        if abs(both.turn_deg) > _MOST_TURN_DEG + unsure_deg:
            return f"camera turned by about {both.turn_deg:.0f} deg, by its estimates of {' and '.join(clear)}"
        return ""

    def answers(self) -> tuple[Answer, Answer]:
        """Return the regressions of shear and of tilt."""
        first = self._frames[len(self._frames) // 2]
        moved_list, measured_list = [], []
        for _, T_base_sensor, T_s_f in self._frames:
            # The surface is static: a motion of the sensor moves it in the sensor's frame by the inverse.
            moved_list.append(se3.log(se3.compose(se3.inverse(T_base_sensor), first[1])))
            measured_list.append(se3.log(se3.compose(T_s_f, se3.inverse(first[2]))))
        moved, measured = np.array(moved_list), np.array(measured_list)
        t = np.array([each[0] for each in self._frames], dtype=np.float64) * 1e-9
        t -= t.mean()
        return (
            _regressed(moved[:, :2], measured[:, :2], t),
            _regressed(moved[:, 3:5], measured[:, 3:5], t, beside=moved[:, :2]),
        )

    def _displacement(self, t_s: float) -> Array:
        """Return the (6,) displacement of the sensor from its start, m and rad."""
        press_s = _PRESS_SHARE * self._duration_s
        pulse_s = 0.5 * (self._duration_s - press_s)
        (first, first_turn), (second, second_turn) = (
            (_pulse(t), _pulse(2.0 * t) - _pulse(2.0 * t - 1.0))
            for t in ((t_s - press_s) / pulse_s - number for number in (0, 1))
        )
        return np.array(
            [
                self._shift_m * first,
                self._shift_m * second,
                self._press_m * min(t_s / press_s, 1.0),
                self._tilt_rad * first_turn,
                self._tilt_rad * second_turn,
                0.0,
            ]
        )


def sheared_for(duration_s: float, shift_mm: float) -> list[tuple[float, float]]:
    """Return shears that a check of a duration reaches, mm, each with how long its first shift exceeds it, s."""
    pulse_s = 0.5 * (1.0 - _PRESS_SHARE) * duration_s
    return [(share * shift_mm, pulse_s * (1.0 - math.acos(1.0 - 2.0 * share) / math.pi)) for share in _SHARES]


def turned_at(duration_s: float, tilt_deg: float) -> float:
    """Return the fastest tilting of a check of a duration, deg/s."""
    return math.pi * tilt_deg / (0.25 * (1.0 - _PRESS_SHARE) * duration_s)


def _pulse(t: float) -> float:
    """Return 0 at 0, 1 at 0.5 and 0 at 1 and beyond, smoothly."""
    return 0.5 * (1.0 - math.cos(2.0 * math.pi * min(max(t, 0.0), 1.0)))


def _pooled(answers: list[Answer]) -> Answer:
    """Return the mean of answers, weighted by their precisions."""
    weights = [1.0 / max(answer.deviation, 1e-9) ** 2 for answer in answers]
    total = sum(weights)
    straight, mirrored = (
        sum(weight * gain for weight, gain in zip(weights, gains, strict=True)) / total
        for gains in ([answer.straight for answer in answers], [answer.mirrored for answer in answers])
    )
    return Answer(straight, mirrored, 1.0 / math.sqrt(total))


def _regressed(moved: Array, measured: Array, t_s: Array, beside: Array | None = None) -> Answer:
    """Regress measured motions (n, 2) in a plane on those of the arm, and on any others ``beside`` them."""
    x, y = (each @ np.array([1.0, 1.0j]) for each in (moved, measured))
    others = [] if beside is None else [beside @ np.array([1.0, 1.0j]), beside @ np.array([1.0, -1.0j])]
    terms = np.column_stack([x, x.conj(), *others, np.ones(len(x)), t_s, t_s * t_s])
    gains, _, _, _ = np.linalg.lstsq(terms, y, rcond=None)
    residual = y - terms @ gains
    variance = float((np.abs(residual) ** 2).sum()) / max(len(x) - terms.shape[1], 1)
    spread = np.linalg.pinv(terms.conj().T @ terms)
    deviation = math.sqrt(max(variance * float(spread[0, 0].real), 0.0))
    drift = terms[:, -3:] @ gains[-3:]
    drift_ratio = float(np.abs(drift - drift[0]).max() / max(np.abs(x - x[0]).max(), 1e-9))
    return Answer(complex(gains[0]), complex(gains[1]), deviation, drift_ratio)
