"""The pipeline does no more than a cell needs, stamps its estimates, and propagates them by the sensor's motion."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

import numpy as np
import pytest

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.errors import EndOfStream
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.perception.models.prediction import Prediction
from touchcell.perception.runtime.contact_gate import ContactGate
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.perception.runtime.filter import PoseFilter, isotropic_noise
from touchcell.perception.runtime.pipeline import ContactPipeline

XI = se3.log(se3.inverse(se3.from_euler_mm_deg([0.5, 0.0, 3.0, 2.0, -4.0, 1.0])))
SIGMA = np.array([3e-4, 3e-4, 1e-4, 0.01, 0.01, 0.02])
REST: ImageArray = np.zeros((16, 16), np.uint8)
PRESSED: ImageArray = np.full((16, 16), 200, np.uint8)


class StubModel:
    """A network with constant output that counts its calls."""

    def __init__(self) -> None:
        self.reductions = 0
        self.inferences = 0

    def reduce(self, image: ImageArray) -> ImageArray:
        self.reductions += 1
        return image

    def predict_reduced(self, reduced: ImageArray) -> Prediction:
        self.inferences += 1
        return Prediction(XI, np.diag(SIGMA**2), in_range=True, markers=0.75)


class StubCamera:
    """Frames every 30 ms of the clock."""

    def __init__(self, clock: VirtualClock, images: list[ImageArray]) -> None:
        self._clock = clock
        self._images = images

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        seq = self._clock.now_ns() // 30_000_000
        if seq >= len(self._images):
            raise EndOfStream("camera", "no more")
        return Stamped(Frame(self._images[seq]), seq * 30_000_000, seq)

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        raise AssertionError("the pipeline never waits for a frame")


def ticks(clock: VirtualClock, n: int) -> Iterator[int]:
    for _ in range(n):
        yield clock.now_ns()
        clock.advance_s(0.01)


def pipeline(images: list[ImageArray], **parts: object) -> tuple[ContactPipeline, StubModel, VirtualClock]:
    clock, model = VirtualClock(), StubModel()
    made = ContactPipeline(StubCamera(clock, images), model, **parts)  # type: ignore[arg-type]
    return made, model, clock


def test_the_estimators_marker_fraction_is_part_of_the_estimate() -> None:
    made, _, clock = pipeline([np.zeros((8, 8), np.uint8)] * 2)
    for now_ns in ticks(clock, 5):
        estimate = made.update(now_ns)
        assert estimate is not None
        assert estimate.markers == 0.75


def pose(x_mm: float) -> Array:
    return se3.from_euler_mm_deg([x_mm, 0, 0, 0, 0, 0])


def test_each_frame_is_processed_once() -> None:
    source, model, clock = pipeline([PRESSED] * 4)
    for now_ns in ticks(clock, 12):
        estimate = source.update(now_ns)
        assert estimate is not None
        assert estimate.seq == now_ns // 30_000_000
    assert model.inferences == 4


def test_without_contact_nothing_is_inferred() -> None:
    source, model, clock = pipeline([REST, REST, PRESSED, REST], contact_gate=ContactGate(REST))
    contacts = [source.update(now_ns) for now_ns in ticks(clock, 12)]
    assert [c.in_contact for c in contacts if c is not None][::3] == [False, False, True, False]
    assert all(c is not None and c.belief is None for c in contacts[:6])
    assert (model.reductions, model.inferences) == (4, 1)


def test_estimate_carries_the_networks_gaussian() -> None:
    source, _, _ = pipeline([PRESSED])
    estimate = source.update(0)
    assert estimate is not None
    assert estimate.belief is not None
    np.testing.assert_allclose(estimate.belief.mean, se3.exp(XI), atol=1e-15)
    J = se3.left_jacobian(XI)
    np.testing.assert_allclose(estimate.belief.covariance, J @ np.diag(SIGMA**2) @ J.T, rtol=1e-9, atol=1e-18)


def test_the_estimate_is_propagated_by_the_motion_since_its_frame() -> None:
    source, _, clock = pipeline([PRESSED] * 2, pose_filter=PoseFilter(isotropic_noise(1e-3, 0.01)))
    for i, now_ns in enumerate(ticks(clock, 3)):
        source.record_pose(now_ns, pose(0.2 * i))
        estimate = source.update(now_ns)
    assert estimate is not None
    assert estimate.belief is not None
    assert (estimate.t_frame_ns, estimate.t_ns) == (0, 20_000_000)
    np.testing.assert_allclose(estimate.belief.mean, pose(-0.4) @ se3.exp(XI), atol=1e-12)


def test_a_new_contact_starts_afresh() -> None:
    source, _, clock = pipeline(
        [PRESSED, REST, PRESSED],
        contact_gate=ContactGate(REST),
        pose_filter=PoseFilter(np.zeros((6, 6))),
    )
    for now_ns in ticks(clock, 7):
        source.record_pose(now_ns, np.eye(4))
        estimate = source.update(now_ns)
    assert estimate is not None
    assert estimate.nis is None
    assert estimate.belief is not None
    J = se3.left_jacobian(XI)
    np.testing.assert_allclose(estimate.belief.covariance, J @ np.diag(SIGMA**2) @ J.T, rtol=1e-9, atol=1e-18)


def test_a_prediction_outside_the_range_is_marked_and_not_fused() -> None:
    strange = np.full_like(PRESSED, 7)

    class Doubtful(StubModel):
        def predict_reduced(self, reduced: ImageArray) -> Prediction:
            good = super().predict_reduced(reduced)
            return good if reduced is not strange else Prediction(XI + 0.01, good.covariance, in_range=False)

    def estimates(images: list[ImageArray]) -> list[ContactEstimate]:
        clock, model = VirtualClock(), Doubtful()
        source = ContactPipeline(StubCamera(clock, images), model, pose_filter=PoseFilter(isotropic_noise(1e-3, 0.01)))
        found = []
        for i, now_ns in enumerate(ticks(clock, 3 * len(images))):
            source.record_pose(now_ns, pose(0.1 * i))
            found.append(source.update(now_ns))
        assert None not in found
        return found  # type: ignore[return-value]

    with_strange = estimates([PRESSED, strange, PRESSED])
    assert [estimate.in_range for estimate in with_strange] == [True] * 3 + [False] * 3 + [True] * 3
    # The previous contact, moved by the arm and less certain, in place of the unreliable one.
    for i, estimate in enumerate(with_strange[:6]):
        assert estimate.belief is not None
        np.testing.assert_allclose(estimate.belief.mean, pose(-0.1 * i) @ se3.exp(XI), atol=1e-9)
    spreads = [np.trace(estimate.belief.covariance) for estimate in with_strange if estimate.belief is not None]
    assert spreads[5] > spreads[3] > spreads[2]
    assert with_strange[3].nis is None
    assert with_strange[6].nis is not None
    # Without a previous contact, the unreliable one itself is returned.
    first = estimates([strange, PRESSED])
    assert not first[2].in_range
    assert first[2].belief is not None
    np.testing.assert_allclose(first[2].belief.mean, se3.exp(XI + 0.01), atol=1e-12)
    assert first[3].belief is not None
    np.testing.assert_allclose(first[3].belief.mean, se3.exp(XI), atol=1e-12)


def test_the_end_of_the_recording_is_reported() -> None:
    source, _, clock = pipeline([PRESSED] * 2)
    for now_ns in ticks(clock, 8):
        last = source.update(now_ns)
    assert source.ended
    assert last is not None
    assert last.seq == 1


def test_stage_times_are_those_of_new_frames_only() -> None:
    clock_ns = count(step=1000)
    source, _, clock = pipeline([PRESSED] * 2, timer=lambda: next(clock_ns))
    seen = []
    for now_ns in ticks(clock, 6):
        source.update(now_ns)
        seen.append(source.times.infer_ns)
    assert seen == [1000, 0, 0, 1000, 0, 0]


def test_a_foreign_image_is_refused(tmp_path: object) -> None:
    class Picky(StubModel):
        def reduce(self, image: ImageArray) -> ImageArray:
            from touchcell.perception.errors import ImageError

            raise ImageError("size", (480, 640), image.shape)

    from touchcell.perception.errors import ImageError

    clock = VirtualClock()
    source = ContactPipeline(StubCamera(clock, [PRESSED]), Picky())  # type: ignore[arg-type]
    with pytest.raises(ImageError):
        source.update(0)


def test_a_frame_older_than_the_newest_is_ignored() -> None:
    made, model, clock = pipeline([PRESSED] * 10, pose_filter=PoseFilter(isotropic_noise(1e-3, 0.01)))
    made.record_pose(0, pose(0))
    clock.advance_s(0.1)
    newest = made.update(clock.now_ns())
    assert newest is not None
    late = StubCamera(VirtualClock(start_ns=40_000_000), [PRESSED] * 10)
    made._camera = late
    again = made.update(clock.now_ns())
    assert again is not None
    assert (again.seq, again.t_frame_ns) == (newest.seq, newest.t_frame_ns)
    assert model.inferences == 1
