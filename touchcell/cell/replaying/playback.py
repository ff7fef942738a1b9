"""Time of a replay, and devices that deliver what was recorded at that time and move nothing."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, TypeVar

import numpy as np
from pydantic import PrivateAttr

from touchcell.cell.recording.messages import COMPONENTS
from touchcell.cell.recording.recorded_images import RecordedImage
from touchcell.cell.replaying.recorded_run import RecordedCycle, RecordedRun, Row, pose_of
from touchcell.drivers.core.arm import Arm
from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device
from touchcell.drivers.core.errors import DeviceError, StaleData
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.protocols import StopCategory
from touchcell.drivers.core.samples import Frame, JointState, Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.estimator_spec import EstimatorConfig, EstimatorContext
from touchcell.perception.runtime.pipeline import ContactSource

T = TypeVar("T")

_SIGMAS = tuple(f"sigma_{name}" for name in COMPONENTS)
_SIGMA_UNITS = np.array([1e-3] * 3 + [np.pi / 180] * 3)


class Playback(Clock):
    """Clock of a replay: a sleep until the next cycle ends at the next recorded one.

    Args:
        run: what is replayed.
    """

    def __init__(self, run: RecordedRun) -> None:
        self._cycles = run.cycles
        self._index = 0
        self._now_ns = run.cycles[0].now_ns
        self.ended = False

    @property
    def cycle(self) -> RecordedCycle:
        """The recorded cycle of this time."""
        return self._cycles[self._index]

    def now_ns(self) -> int:
        """Return the time of the cycle."""
        return self._now_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Advance to the next recorded cycle; behind the last one, to ``t_ns``."""
        if self._index + 1 < len(self._cycles):
            self._index += 1
            self._now_ns = max(self._now_ns, self.cycle.now_ns)
        else:
            self.ended = True
            self._now_ns = max(self._now_ns, t_ns)


class _Recorded(Device):
    """A device that reports what was recorded of it; its subclasses say what else it delivers.

    Args:
        name: of the device in the cell.
        role: of the device in the recording.
        playback: time.
    """

    def __init__(self, name: str, role: str, playback: Playback) -> None:
        super().__init__(name, playback)
        self._role = role
        self._playback = playback

    def health(self) -> dict[str, float | int | str | bool]:
        """Return what it reported about itself."""
        return dict(self._playback.cycle.health.get(self.name, {}))

    def _open(self) -> None:
        """Nothing to open."""

    def _close(self) -> None:
        """Nothing to close."""


class RecordedPoses(_Recorded):
    """An arm that only reports where it was.

    Args:
        name: of the arm in the cell.
        role: of the arm in the recording.
        playback: time.
    """

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the recorded state. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.states.get(self._role), max_age_s)


class RecordedArm(Arm):
    """An arm that is where it was, whatever it is commanded; its gate judges commands as that of the real one.

    Limits of joints, which some drivers apply behind the gate, are not replayed.

    Args:
        name: of the arm in the cell.
        role: of the arm in the recording.
        playback: time.
        limits: what the gate allows.
        stop_categories: that the recorded arm's driver offers.
    """

    def __init__(
        self,
        name: str,
        role: str,
        playback: Playback,
        limits: TwistLimits,
        stop_categories: frozenset[int],
    ) -> None:
        super().__init__(name, playback, limits, stop_categories=stop_categories or {StopCategory.STOP_AND_HOLD})
        self._role = role
        self._playback = playback

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        """Return the recorded state. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.states.get(self._role), max_age_s)

    def joints(self, max_age_s: float | None = None) -> Stamped[JointState]:
        """Return the recorded joints. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.joints.get(self._role), max_age_s)

    def wrench(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return the recorded wrench. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.wrenches.get(self._role), max_age_s)

    def external_torques(self, max_age_s: float | None = None) -> Stamped[Array]:
        """Return the recorded external torques. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.external_torques.get(self._role), max_age_s)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return what it reported about itself."""
        return dict(self._playback.cycle.health.get(self.name, {}))

    def at_rest(self) -> bool:
        """Nothing moves in a replay."""
        return True

    def _open(self) -> None:
        """Nothing to open."""

    def _close(self) -> None:
        """Nothing to close."""

    def _stream_twist(self, twist_base: Array, ttl_s: float, now_ns: int) -> None:
        """The gate has judged it; nothing follows it."""

    def _begin_stop(self, category: StopCategory) -> None:
        """It stands."""


class RecordedCamera(_Recorded):
    """A camera that delivers the recorded images, each from the cycle on that used it.

    Args:
        name: of the sensor in the cell.
        role: of the sensor in the recording.
        playback: time.
        images: its images, in their order.
    """

    def __init__(self, name: str, role: str, playback: Playback, images: Iterator[RecordedImage]) -> None:
        super().__init__(name, role, playback)
        self._images = images
        self._newest: RecordedImage | None = None
        self._coming: RecordedImage | None = None
        self._seq = 0

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest image that the cycle knew. Raises StaleData, DeviceError."""
        contact = self._playback.cycle.contacts.get(self._role, {})
        used_ns = int(contact.get("t_frame_ns", self._playback.now_ns()))
        self._advance(used_ns)
        if self._newest is None:
            raise DeviceError(self.name, "no image of its first cycle is recorded", hint="record the run again")
        if self._newest.t_ns == used_ns:
            self._seq = int(contact.get("seq", self._seq))
        return _fresh(
            self.name, self._playback, Stamped(Frame(self._newest.image), self._newest.t_ns, self._seq), max_age_s
        )

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the newest image, as ``latest``."""
        return self.latest()

    def _advance(self, t_ns: int) -> None:
        """Take images up to the time ``t_ns``."""
        while True:
            if self._coming is None:
                self._coming = next(self._images, None)
            if self._coming is None or self._coming.t_ns > t_ns:
                return
            self._newest, self._coming = self._coming, None


class RecordedDevice(_Recorded):
    """Another device, with its recorded readings; settings that it is given have no effect.

    Args:
        name: of the device in the cell.
        role: of the device in the recording.
        playback: time.
    """

    def read(self, max_age_s: float | None = None) -> Stamped[Mapping[str, float]]:
        """Return the recorded reading. Raises StaleData, DeviceError."""
        return _fresh(self.name, self._playback, self._playback.cycle.readings.get(self._role), max_age_s)

    def apply(self, setting: Mapping[str, float]) -> None:
        """Do nothing."""


class RecordedContacts(ContactSource):
    """The contact estimates of a run without images, as they were.

    Covariances are recorded by their standard deviations alone, so correlations are missing. As in a run, cycles
    without a new estimate have the same belief object: tasks count each once.

    Args:
        role: of the sensor.
        playback: time.
    """

    def __init__(self, role: str, playback: Playback) -> None:
        self._role = role
        self._playback = playback
        self._belief: PoseGaussian | None = None

    def take_zero(self) -> bool:
        """Compare with nothing."""
        return True

    def record_pose(self, t_ns: int, T_base_sensor: Array) -> None:
        """The estimates know already."""

    def update(self, now_ns: int) -> ContactEstimate | None:
        """Return the estimate of the cycle; None where it has none."""
        cycle = self._playback.cycle
        data = cycle.contacts.get(self._role)
        if data is None:
            return None
        belief, before = _belief(data), self._belief
        if belief is not None and before is not None and _same(belief, before):
            belief = before
        self._belief = belief
        t_frame_ns = int(data.get("t_frame_ns", now_ns))
        row = cycle.measurements.get(self._role, {})
        measured = _belief(row) if row.get("seq") == data.get("seq") else None
        # Without a filter the estimate is that of the frame; a filter brings it to the present.
        unfiltered = belief is not None and measured is not None and np.array_equal(belief.mean, measured.mean)
        return ContactEstimate(
            bool(data.get("in_contact", False)),
            belief,
            t_frame_ns,
            int(data.get("seq", 0)),
            t_frame_ns if unfiltered else now_ns,
            in_range=bool(data.get("in_range", True)),
            nis=_number(data.get("nis")),
            markers=_number(data.get("markers")),
            measured=measured,
            refusal=str(data.get("refusal", "")),
            change=_number(data.get("change")),
        )


def _belief(data: Row) -> PoseGaussian | None:
    T_f_s = pose_of(data)
    if not np.isfinite(T_f_s).all():
        return None
    sigma = np.array([_number(data.get(name)) or 0.0 for name in _SIGMAS]) * _SIGMA_UNITS
    return PoseGaussian(se3.inverse(T_f_s), np.diag(sigma**2))


def _same(first: PoseGaussian, second: PoseGaussian) -> bool:
    return np.array_equal(first.mean, second.mean) and np.array_equal(first.covariance, second.covariance)


def _number(value: Any) -> float | None:
    return float(value) if isinstance(value, int | float) else None


class _RecordedEstimator(EstimatorConfig):
    """Section of a sensor whose estimates come from a recording."""

    kind: str = "recorded"
    _contacts: RecordedContacts = PrivateAttr()

    def build(self, context: EstimatorContext) -> RecordedContacts:
        """Return the recorded contacts."""
        return self._contacts


def recorded_estimator(role: str, playback: Playback) -> EstimatorConfig:
    """Return the section of a sensor whose estimates are those of the recording, by its role there."""
    section = _RecordedEstimator()
    section._contacts = RecordedContacts(role, playback)
    return section


def _fresh(name: str, playback: Playback, sample: Stamped[T] | None, max_age_s: float | None) -> Stamped[T]:
    """Return a sample that was recorded and is not too old. Raises DeviceError, StaleData."""
    if sample is None:
        raise DeviceError(name, "what is asked of it was not recorded")
    if max_age_s is not None and (age_s := sample.age_s(playback.now_ns())) > max_age_s:
        raise StaleData(name, age_s, max_age_s, sample.seq)
    return sample
