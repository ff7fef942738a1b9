"""Interlocks on tactile sensing: frames are live, estimates are valid, the contact holds."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, PositiveFloat, PositiveInt

from touchcell.control.interlocks.coverage import (
    HELD_S,
    CannotTrip,
    CellFacts,
    Fault,
    SensorFacts,
    just_beyond,
    of_each_sensor,
    states_of,
    unchanged,
    with_sensor,
)
from touchcell.control.interlocks.level import Level
from touchcell.control.interlocks.settings import LEAVE, GradedSettings, InterlockSettings
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.timers import (
    InterlockState,
    Judgement,
    OnDelay,
    Reading,
    Sustained,
    TimedInterlock,
    TimerState,
    overdue,
    waited,
)
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.geometry.types import Array

_BASELINE_FRAMES = 10
_WILD_NIS = 1000.0
"""A normalised innovation squared of this size must trip: no filter of six degrees of freedom explains it."""


@dataclass(frozen=True, slots=True)
class FrameFrozen:
    """Require frames to change with time: by content where the image is hashed, else by frame number."""

    name: str
    severity: Severity
    limit_s: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the sensor whose frame has been unchanged longest, if too long."""
        marks = {}
        for role, sensor in view.sensors.items():
            identity = (float(sensor.seq if sensor.content is None else sensor.content),)
            mark = past.get(role)
            if mark is None or mark.values != identity:
                mark = TimerState(view.now_ns, values=identity)
            marks[role] = mark
        return overdue(self.name, self.severity, view, marks, self.limit_s, lambda _: "the same picture"), marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield for how long each image has been the same."""
        yield from waited(view, past, self.limit_s)


@dataclass(frozen=True, slots=True)
class Exposure:
    """Keep the brightness of a sensor's frames near that of the first ten."""

    name: str
    severity: Severity
    limit_percent: float

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the first sensor whose frames have become too bright or too dark."""
        marks = dict(past)
        found: Violation | None = None
        for role, sensor in view.sensors.items():
            if sensor.brightness is None:
                continue
            mark = past.get(role, TimerState(view.now_ns, count=0, values=(0.0,)))
            if mark.count < _BASELINE_FRAMES:
                if mark.seq != sensor.seq:
                    mean = (mark.values[0] * mark.count + sensor.brightness) / (mark.count + 1)
                    mark = TimerState(view.now_ns, mark.count + 1, sensor.seq, (mean,))
            else:
                change = 100.0 * abs(sensor.brightness / max(mark.values[0], 1e-6) - 1.0)
                if found is None and change > self.limit_percent:
                    found = Violation(
                        self.name,
                        self.severity,
                        role,
                        f"brightness {sensor.brightness:.1f} is {change:.1f} % off the first frames' "
                        f"{mark.values[0]:.1f}, limit {self.limit_percent:g} %",
                        view.now_ns,
                        value=change,
                        limit=self.limit_percent,
                        unit="%",
                        frame_seq=sensor.seq,
                    )
            marks[role] = mark
        return found, marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield by how much each brightness is off."""
        for role, sensor in view.sensors.items():
            mark = past.get(role)
            if sensor.brightness is not None and mark is not None and mark.count >= _BASELINE_FRAMES:
                change = 100.0 * abs(sensor.brightness / max(mark.values[0], 1e-6) - 1.0)
                yield Level(role, change, self.limit_percent, "%")


@dataclass(frozen=True, slots=True)
class ContactLost:
    """Limit the time without contact, after one was made, while the task is in one of ``states``."""

    name: str
    severity: Severity
    limit_s: float
    states: frozenset[str]

    def evaluate(self, view: CellView, past: InterlockState) -> Judgement:
        """Return a violation for the sensor whose contact has been missing longest, if too long."""
        if view.task_state not in self.states:
            return None, {}
        marks = {
            role: TimerState(view.now_ns) if sensor.in_contact else past[role]
            for role, sensor in view.sensors.items()
            if sensor.in_contact or role in past
        }
        words = f"no contact in {view.task_state}"
        return overdue(self.name, self.severity, view, marks, self.limit_s, lambda _: words), marks

    def levels(self, view: CellView, past: InterlockState) -> Iterator[Level]:
        """Yield for how long contacts have been missing."""
        yield from waited(view, past, self.limit_s)


def _depth_deviations(view: CellView) -> Iterator[Reading]:
    for role, sensor in view.sensors.items():
        if sensor.sigma_depth_m is not None:
            yield Reading(role, 1e3 * sensor.sigma_depth_m, sensor.seq)


def _innovations(view: CellView) -> Iterator[Reading]:
    for role, sensor in view.sensors.items():
        if sensor.nis is not None:
            yield Reading(role, sensor.nis, sensor.seq)


def _shears(view: CellView) -> Iterator[Reading]:
    for role, sensor in view.sensors.items():
        if sensor.shear_m is not None:
            yield Reading(role, 1e3 * sensor.shear_m, sensor.seq)


def _torsions(view: CellView) -> Iterator[Reading]:
    for role, sensor in view.sensors.items():
        if sensor.torsion_rad is not None:
            yield Reading(role, math.degrees(abs(sensor.torsion_rad)), sensor.seq)


def _markers_missing(view: CellView) -> Iterator[Reading]:
    for role, sensor in view.sensors.items():
        if sensor.markers is not None:
            yield Reading(role, 100.0 * (1.0 - sensor.markers), sensor.seq)


@dataclass(frozen=True, slots=True)
class _ShearPerDepth:
    """Ratio of shear to depth of each contact that is deep enough for a reliable ratio."""

    min_depth_m: float
    states: frozenset[str]

    def __call__(self, view: CellView) -> Iterator[Reading]:
        if not view.works_in(self.states):
            return
        for role, sensor in view.sensors.items():
            if sensor.shear_m is not None and sensor.depth_m is not None and sensor.depth_m >= self.min_depth_m:
                yield Reading(role, sensor.shear_m / sensor.depth_m, sensor.seq)


def _out_of_range(view: CellView) -> Mapping[str, str]:
    return {
        role: sensor.refusal or "outside the training range"
        for role, sensor in view.sensors.items()
        if not sensor.in_range
    }


class FrameFrozenConfig(InterlockSettings):
    """Longest time that a sensor's image may stay identical, noise included.

    Attributes:
        limit_ms: longest time with the same image.
    """

    kind: Literal["frame_frozen"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with an image that stays the same while time passes."""

        def frozen(role: str, sensor: SensorFacts) -> Fault:
            content = 0 if sensor.images else None
            return Fault(
                role,
                "an image that stays the same",
                f"{self.limit_ms:g} ms",
                lambda view, t_s: with_sensor(view, role, seq=0, content=content),
                key="limit_ms",
                hint=f"lower it below {1e3 * HELD_S:g} ms",
            )

        return of_each_sensor(facts, lambda sensor: True, "", frozen)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``FrameFrozen`` interlock."""
        return FrameFrozen(name, self.level, 1e-3 * self.limit_ms)


class ExposureConfig(InterlockSettings):
    """Largest change of a sensor's brightness.

    Attributes:
        limit_percent: largest change of the mean grey level.
    """

    kind: Literal["exposure"]
    limit_percent: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with images that turn black."""

        def dark(role: str, sensor: SensorFacts) -> Fault:
            return Fault(
                role,
                "black images",
                f"{self.limit_percent:g} %",
                lambda view, t_s: with_sensor(view, role, brightness=0.0),
                before_s=(_BASELINE_FRAMES + 2) / sensor.frame_rate_hz,
                key="limit_percent",
                hint="lower it below 100",
            )

        return of_each_sensor(facts, lambda sensor: sensor.images, "has no images", dark)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``Exposure`` interlock."""
        return Exposure(name, self.level, self.limit_percent)


class ContactLostConfig(InterlockSettings):
    """Longest time without an established contact while the task is in one of ``states``.

    Attributes:
        limit_ms: longest time without contact.
        states: states of the task in which it is judged.
    """

    kind: Literal["contact_lost"]
    limit_ms: PositiveFloat
    states: tuple[str, ...] = Field(default=("approach", "settle", "run"), min_length=1)

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each sensor with a contact that is lost."""
        states, wrong = states_of(self.states, facts, chosen="states" in self.model_fields_set)
        yield from wrong
        if wrong:
            return

        def lost(role: str, sensor: SensorFacts) -> Fault:
            return Fault(
                role,
                "contact lost",
                f"{self.limit_ms:g} ms",
                unchanged,
                lambda view, t_s: with_sensor(view, role, in_contact=True),
                states=states,
                key="limit_ms",
                hint=f"lower it below {1e3 * HELD_S:g} ms",
            )

        yield from of_each_sensor(facts, lambda sensor: True, "", lost)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the ``ContactLost`` interlock."""
        return ContactLost(name, self.level, 1e-3 * self.limit_ms, frozenset(self.states))


class UncertainConfig(GradedSettings):
    """Largest standard deviation of the estimated depth, and how long it may be exceeded.

    Attributes:
        limit_mm: largest standard deviation of the depth.
        leave_mm: deviation below which the time starts anew; none for a share of the limit.
        hold_ms: how long it may be exceeded.
    """

    kind: Literal["uncertain"]
    limit_mm: PositiveFloat
    leave_mm: PositiveFloat | None = None
    hold_ms: NonNegativeFloat = 0.0

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with a depth that is not well known."""

        def beyond(role: str, sensor: SensorFacts) -> Fault:
            value = just_beyond(self.limit_mm, 1e3 * sensor.sigma_m)
            return Fault(
                role,
                f"standard deviation {value:.3g} mm",
                f"{self.limit_mm:g} mm",
                lambda view, t_s: with_sensor(view, role, in_contact=True, sigma_depth_m=1e-3 * value),
                key="limit_mm",
                hint=f"lower it: {sensor.estimator} reports {1e3 * sensor.sigma_m:.3g} mm at most",
            )

        return of_each_sensor(facts, lambda sensor: sensor.sigma_m > 0.0, "reports no standard deviation", beyond)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on the standard deviation of the depth."""
        leave, hold_s = self.leave_mm or LEAVE * self.limit_mm, 1e-3 * self.hold_ms
        what = "standard deviation of the depth"
        return Sustained(name, self.level, _depth_deviations, what, self.limit_mm, leave, "mm", hold_s)


class OutOfRangeConfig(GradedSettings):
    """Longest time outside the range that the network was trained on.

    Attributes:
        limit_ms: longest time outside the range.
    """

    kind: Literal["out_of_range"]
    limit_ms: PositiveFloat

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with an estimate outside the training range."""

        def outside(role: str, sensor: SensorFacts) -> Fault:
            return Fault(
                role,
                "outside the training range",
                f"{self.limit_ms:g} ms",
                lambda view, t_s: with_sensor(view, role, in_contact=True, in_range=False),
                key="limit_ms",
                hint=f"lower it below {1e3 * HELD_S:g} ms",
            )

        return of_each_sensor(facts, lambda sensor: sensor.leaves_range, "has no training range", outside)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on the training range."""
        return OnDelay(name, self.level, _out_of_range, 1e-3 * self.limit_ms)


class InconsistentConfig(GradedSettings):
    """Largest normalised innovation squared of the filter, and in how many consecutive frames it may be exceeded.

    A consistent filter with six degrees of freedom exceeds 22.5 in one frame of a thousand.

    Attributes:
        limit_nis: largest normalised innovation squared, six degrees of freedom.
        leave_nis: value below which the count of frames ends; none for a share of the limit.
        frames: consecutive frames that may exceed it.
    """

    kind: Literal["inconsistent"]
    limit_nis: PositiveFloat
    leave_nis: PositiveFloat | None = None
    frames: PositiveInt

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with innovations that do not match its filter."""

        def off(role: str, sensor: SensorFacts) -> Fault:
            nis = just_beyond(self.limit_nis, _WILD_NIS)
            return Fault(
                role,
                f"normalised innovation squared {nis:.3g}",
                f"{self.limit_nis:g}",
                lambda view, t_s: with_sensor(view, role, in_contact=True, nis=nis),
                key="limit_nis",
                hint=f"lower it below {_WILD_NIS:g}, and `frames` below {HELD_S * sensor.frame_rate_hz:g}",
            )

        return of_each_sensor(facts, lambda sensor: sensor.innovations, "has no filter", off)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on the filter's consistency."""
        leave = self.leave_nis or LEAVE * self.limit_nis
        what = "normalised innovation squared"
        return Sustained(name, self.level, _innovations, what, self.limit_nis, leave, "", frames=self.frames)


class ShearConfig(GradedSettings):
    """Largest tangential shear of any contact: beyond it the skin saturates or slips.

    Attributes:
        limit_mm: largest tangential shear.
        leave_mm: shear below which the time starts anew; none for a share of the limit.
        hold_ms: how long it may be exceeded.
    """

    kind: Literal["shear"]
    limit_mm: PositiveFloat
    leave_mm: PositiveFloat | None = None
    hold_ms: NonNegativeFloat = 0.0

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor sheared too far."""

        def beyond(role: str, sensor: SensorFacts) -> Fault:
            value = just_beyond(self.limit_mm, 1e3 * sensor.shear_m)
            return Fault(
                role,
                f"sheared by {value:.3g} mm",
                f"{self.limit_mm:g} mm",
                lambda view, t_s: with_sensor(view, role, in_contact=True, shear_m=1e-3 * value),
                key="limit_mm",
                hint=f"lower it: {sensor.estimator} reports {1e3 * sensor.shear_m:.3g} mm at most",
            )

        return of_each_sensor(facts, lambda sensor: sensor.shear_m > 0.0, "reports no shear", beyond)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on shear."""
        leave, hold_s = self.leave_mm or LEAVE * self.limit_mm, 1e-3 * self.hold_ms
        return Sustained(name, self.level, _shears, "sheared by", self.limit_mm, leave, "mm", hold_s)


class TorsionConfig(GradedSettings):
    """Largest rotation of any contact about the surface normal.

    Attributes:
        limit_deg: largest rotation about the surface normal.
        leave_deg: rotation below which the time starts anew; none for a share of the limit.
        hold_ms: how long it may be exceeded.
    """

    kind: Literal["torsion"]
    limit_deg: PositiveFloat
    leave_deg: PositiveFloat | None = None
    hold_ms: NonNegativeFloat = 0.0

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor twisted too far."""

        def beyond(role: str, sensor: SensorFacts) -> Fault:
            value = just_beyond(self.limit_deg, math.degrees(sensor.torsion_rad))
            return Fault(
                role,
                f"twisted by {value:.3g} deg",
                f"{self.limit_deg:g} deg",
                lambda view, t_s: with_sensor(view, role, in_contact=True, torsion_rad=math.radians(value)),
                key="limit_deg",
                hint=f"lower it: {sensor.estimator} reports {math.degrees(sensor.torsion_rad):.3g} deg at most",
            )

        return of_each_sensor(facts, lambda sensor: sensor.torsion_rad > 0.0, "reports no torsion", beyond)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on torsion."""
        leave, hold_s = self.leave_deg or LEAVE * self.limit_deg, 1e-3 * self.hold_ms
        return Sustained(name, self.level, _torsions, "twisted by", self.limit_deg, leave, "deg", hold_s)


class SlipConfig(GradedSettings):
    """Largest ratio of tangential shear to depth of a contact, while the task is in one of ``states``, or in any.

    On real images, estimates of shear fall behind the motion once shear exceeds depth: there the skin begins to
    slide. Contacts shallower than ``min_depth_mm`` are not judged.

    Attributes:
        limit_ratio: largest ratio of shear to depth.
        leave_ratio: ratio below which the time starts anew; none for a share of the limit.
        hold_ms: how long it may be exceeded.
        min_depth_mm: contacts shallower than this are not judged.
        states: states of the task in which it is judged; none for all.
    """

    kind: Literal["slip"]
    limit_ratio: PositiveFloat
    leave_ratio: PositiveFloat | None = None
    hold_ms: NonNegativeFloat = 0.0
    min_depth_mm: PositiveFloat = 1.0
    states: tuple[str, ...] = ()

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each sensor sheared too far for its depth."""
        states, wrong = states_of(self.states, facts)
        yield from wrong
        if wrong:
            return

        def sliding(role: str, sensor: SensorFacts) -> Fault:
            depth_m = min(1e-3 * self.min_depth_mm, 0.99 * sensor.depth_m)
            shear_m = just_beyond(self.limit_ratio * depth_m, sensor.shear_m)
            return Fault(
                role,
                f"sheared by {1e3 * shear_m:.2f} mm at {1e3 * depth_m:.2f} mm",
                f"{self.limit_ratio:g}",
                lambda view, t_s: with_sensor(view, role, in_contact=True, depth_m=depth_m, shear_m=shear_m),
                states=states,
                key="limit_ratio",
                hint=f"{sensor.estimator} reports {1e3 * sensor.shear_m:.1f} mm of shear and "
                f"{1e3 * sensor.depth_m:.1f} mm of depth at most",
            )

        yield from of_each_sensor(
            facts, lambda sensor: sensor.shear_m > 0.0 < sensor.depth_m, "reports no shear", sliding
        )

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on shear per depth."""
        leave, hold_s = self.leave_ratio or LEAVE * self.limit_ratio, 1e-3 * self.hold_ms
        measure = _ShearPerDepth(1e-3 * self.min_depth_mm, frozenset(self.states))
        return Sustained(name, self.level, measure, "shear per depth", self.limit_ratio, leave, "", hold_s)


class MarkersLostConfig(InterlockSettings):
    """Largest fraction of the markers expected in view that may be missing, and in how many consecutive frames.

    Only estimators that detect markers report it; for others it never trips.

    Attributes:
        limit_percent: largest share of missing markers.
        leave_percent: share below which the count of frames ends; none for a share of the limit.
        frames: consecutive frames that may exceed it.
    """

    kind: Literal["markers_lost"]
    limit_percent: Annotated[float, Field(gt=0.0, lt=100.0)]
    leave_percent: PositiveFloat | None = None
    frames: PositiveInt = 1

    def faults(self, facts: CellFacts) -> Iterable[Fault | CannotTrip]:
        """Return each sensor with too many markers missing."""

        def missing(role: str, sensor: SensorFacts) -> Fault:
            percent = just_beyond(self.limit_percent, 100.0)
            return Fault(
                role,
                f"{percent:.3g} % of the markers missing",
                f"{self.limit_percent:g} %",
                lambda view, t_s: with_sensor(view, role, markers=1.0 - 0.01 * percent),
                key="frames",
                hint=f"lower it below {HELD_S * sensor.frame_rate_hz:g}",
            )

        return of_each_sensor(facts, lambda sensor: sensor.markers, "detects no markers", missing)

    def build(self, name: str, T_tcp_sensor: Mapping[str, Array]) -> TimedInterlock:
        """Return the interlock on missing markers."""
        leave = self.leave_percent or LEAVE * self.limit_percent
        what = "markers missing:"
        return Sustained(name, self.level, _markers_missing, what, self.limit_percent, leave, "%", frames=self.frames)


FRAME_FROZEN = InterlockSpec("frame_frozen", "tactile frames are not frozen: their content changes", FrameFrozenConfig)
EXPOSURE = InterlockSpec("exposure", "brightness stays near that of the first frames", ExposureConfig)
UNCERTAIN = InterlockSpec("uncertain", "standard deviation of the depth is below a limit", UncertainConfig)
OUT_OF_RANGE = InterlockSpec("out_of_range", "the estimate stays inside the network's training range", OutOfRangeConfig)
INCONSISTENT = InterlockSpec("inconsistent", "innovations match the filter's covariance", InconsistentConfig)
CONTACT_LOST = InterlockSpec("contact_lost", "an established contact is not lost for long", ContactLostConfig)
SHEAR = InterlockSpec("shear", "shear of every contact stays below saturation or slip", ShearConfig)
TORSION = InterlockSpec("torsion", "torsion of every contact stays below a limit", TorsionConfig)
SLIP = InterlockSpec("slip", "shear per depth of every contact stays below slip", SlipConfig)
MARKERS_LOST = InterlockSpec("markers_lost", "most of the markers expected in view are detected", MarkersLostConfig)
