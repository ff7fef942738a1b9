"""Frames perceived in a thread of their own: order, poses, errors, zero and end are those of the loop's thread."""

from __future__ import annotations

import threading
from queue import Empty, SimpleQueue

import numpy as np
import pytest

from tests.helpers.franka_harness import eventually
from touchcell.drivers.core.errors import DeviceGone, EndOfStream
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.filter_spec import FilterState
from touchcell.perception.runtime.pipeline import ContactPipeline

REST: ImageArray = np.zeros((16, 16), np.uint8)
PRESSED: ImageArray = np.full((16, 16), 200, np.uint8)
PERIOD_NS = 30_000_000


class HandCamera:
    """Shows a frame until the test shows another, or an error."""

    def __init__(self) -> None:
        self.shown: Stamped[Frame] | BaseException = Stamped(Frame(PRESSED), 0, 0)

    def show(self, seq: int, image: ImageArray = PRESSED) -> None:
        self.shown = Stamped(Frame(image), seq * PERIOD_NS, seq)

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        if isinstance(self.shown, BaseException):
            raise self.shown
        return self.shown

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        raise AssertionError("never asked")


class NotingModel:
    """Estimates the same for every image, and notes in which thread; waits for the test where it is asked to."""

    def __init__(self) -> None:
        self.threads: list[threading.Thread] = []
        self.held: SimpleQueue[None] | None = None

    def reduce(self, image: ImageArray) -> ImageArray:
        return image

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        self.threads.append(threading.current_thread())
        if self.held is not None:
            self.held.get(timeout=30.0)
        return Prediction(np.zeros(6), np.eye(6), in_range=True)


class NotingFilter:
    """Notes where the sensor was at each frame, and the thread that asked."""

    def __init__(self) -> None:
        self.at: list[tuple[float, int]] = []
        self.threads: set[threading.Thread] = set()
        self.resets = 0

    def reset(self) -> None:
        self.resets += 1

    def predict(self, T_base_sensor: Array, t_ns: int) -> PoseGaussian:
        return PoseGaussian(T_base_sensor, np.eye(6))

    def update(self, observation: PoseGaussian, T_base_sensor: Array, t_ns: int) -> FilterState:
        self.threads.add(threading.current_thread())
        self.at.append((round(1e3 * T_base_sensor[0, 3], 3), t_ns))
        return FilterState(observation, T_base_sensor, t_ns)


@pytest.fixture
def camera() -> HandCamera:
    return HandCamera()


def until(source: ContactPipeline, seq: int) -> ContactEstimate:
    """Update until the frame of that number is there."""
    found: list[ContactEstimate] = []

    def there() -> bool:
        estimate = source.update(10**9)
        if estimate is not None:
            found.append(estimate)
        return estimate is not None and estimate.seq >= seq

    eventually(there)
    return found[-1]


def test_frames_are_read_in_the_thread_and_filtered_in_the_loop(camera: HandCamera) -> None:
    model, noting = NotingModel(), NotingFilter()
    source = ContactPipeline(camera, model, pose_filter=noting)  # type: ignore[arg-type]
    for k in range(4):
        source.record_pose(k * PERIOD_NS, se3.from_euler_mm_deg([k, 0, 0, 0, 0, 0]))
    source.begin_thread("perceives it")
    first = source.update(0)
    assert first is not None, "there is an estimate from the first cycle on"
    for seq in (1, 2, 3):
        camera.show(seq)
        until(source, seq)
    source.end_thread()
    assert [thread.name for thread in model.threads] == ["MainThread"] + ["perceives it"] * 3
    assert not any(thread.is_alive() for thread in model.threads[1:])
    assert noting.threads == {threading.main_thread()}
    assert noting.at == [(float(k), k * PERIOD_NS) for k in range(4)]
    camera.show(4)
    after = source.update(4 * PERIOD_NS)
    assert after is not None
    assert after.seq == 4
    assert model.threads[-1] is threading.main_thread()


def test_a_loop_that_is_late_gets_every_frame_in_order(camera: HandCamera) -> None:
    model, noting = NotingModel(), NotingFilter()
    source = ContactPipeline(camera, model, pose_filter=noting)  # type: ignore[arg-type]
    source.begin_thread("perceives it")
    for seq in (1, 2, 3):
        camera.show(seq)
        eventually(lambda seq=seq: len(model.threads) == seq + 1)  # type: ignore[misc]
    until(source, 3)
    source.end_thread()
    assert [t_ns for _, t_ns in noting.at] == [k * PERIOD_NS for k in range(4)]


def test_what_a_camera_raises_is_raised_in_the_loop_until_it_delivers_again(camera: HandCamera) -> None:
    source = ContactPipeline(camera, NotingModel())  # type: ignore[arg-type]
    source.begin_thread("perceives it")
    source.update(0)
    camera.shown = DeviceGone("camera", "unplugged")
    raised = []

    def twice() -> bool:
        try:
            source.update(0)
        except DeviceGone as error:
            raised.append(error)
        return len(raised) == 2

    eventually(twice)
    camera.show(1)
    found: list[int] = []

    def delivers() -> bool:
        try:
            estimate = source.update(10**9)
        except DeviceGone:
            return False
        found.append(-1 if estimate is None else estimate.seq)
        return found[-1] == 1

    eventually(delivers)
    source.end_thread()


def test_a_loop_that_is_late_is_told_the_first_of_several_errors(camera: HandCamera) -> None:
    class Failing(HandCamera):
        asked = 0

        def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
            self.asked += 1
            if self.asked > 1:
                raise DeviceGone("camera", "unplugged" if self.asked == 2 else "is FAULTED")
            return super().latest()

    failing = Failing()
    source = ContactPipeline(failing, NotingModel())  # type: ignore[arg-type]
    source.begin_thread("perceives it")
    eventually(lambda: failing.asked > 3)
    source.update(0)
    with pytest.raises(DeviceGone, match="unplugged"):
        source.update(0)
    source.end_thread()


def test_a_first_frame_that_fails_fails_the_start(camera: HandCamera) -> None:
    camera.shown = DeviceGone("camera", "unplugged")
    source = ContactPipeline(camera, NotingModel())  # type: ignore[arg-type]
    before = threading.active_count()
    with pytest.raises(DeviceGone):
        source.begin_thread("perceives it")
    source.end_thread()
    assert threading.active_count() == before


def test_a_new_zero_waits_for_the_frame_at_work_and_drops_what_the_old_one_saw(camera: HandCamera) -> None:
    model, noting, held = NotingModel(), NotingFilter(), SimpleQueue[None]()
    gate = ContactGate(REST)
    source = ContactPipeline(camera, model, contact_gate=gate, pose_filter=noting)  # type: ignore[arg-type]
    source.begin_thread("perceives it")
    assert source.update(0) is not None
    model.held = held
    camera.show(1)
    eventually(lambda: len(model.threads) == 2)
    zeroed: SimpleQueue[bool] = SimpleQueue()
    zero = threading.Thread(target=lambda: zeroed.put(source.take_zero()))
    zero.start()
    with pytest.raises(Empty):
        zeroed.get_nowait()
    held.put(None)
    assert zeroed.get(timeout=30.0)
    zero.join()
    model.held = None
    # Frame 1 was in contact by the old zero, which it has become itself.
    estimate = source.update(PERIOD_NS)
    assert estimate is not None
    assert (estimate.seq, noting.resets) == (0, 1)
    camera.show(2)
    assert not until(source, 2).in_contact
    source.end_thread()


def test_the_end_of_a_recording_comes_after_its_last_frame(camera: HandCamera) -> None:
    model = NotingModel()
    source = ContactPipeline(camera, model)  # type: ignore[arg-type]
    source.begin_thread("perceives it")
    camera.show(1)
    eventually(lambda: len(model.threads) == 2)
    camera.shown = EndOfStream("camera", "no more")
    seen = []

    def ended() -> bool:
        estimate = source.update(10**9)
        seen.append((None if estimate is None else estimate.seq, source.ended))
        return source.ended

    eventually(ended)
    assert seen[-1] == (1, True)
    source.end_thread()
