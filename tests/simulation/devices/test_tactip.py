import numpy as np
import pytest
from pydantic import ValidationError

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.errors import DeviceGone, LifecycleError, StaleData, TransportTimeout
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.simulation.devices.arm import SimArm
from touchcell.simulation.devices.tactip import SimTactip, SimTactipConfig
from touchcell.simulation.faults import FrameFaults
from touchcell.simulation.scene import Scene, SceneConfig


class Cell:
    """One arm that holds its tip 5 mm above a table."""

    def __init__(self, seed: int = 0, name: str = "tip", **changes: object) -> None:
        self.clock = VirtualClock()
        self.scene: Scene = SceneConfig.model_validate({"surfaces": {"table": {"kind": "plane"}}}).build(self.clock)
        context = DriverContext(self.clock, {}, self.scene, seed)
        arm_spec, tip_spec = DRIVERS.load("sim_arm"), DRIVERS.load("sim_tactip")
        arm = arm_spec.build("arm", arm_spec.config(start_pose_mm_deg=(400, 0, 125, 180, 0, 0)), context)
        assert isinstance(arm, SimArm)
        self.arm = arm
        config = SimTactipConfig.model_validate(
            {"mounted_on": "arm", "tcp_to_sensor_mm_deg": (0, 0, 100, 0, 0, 0), "rate_hz": 50, **changes}
        )
        tip = tip_spec.build(name, config, DriverContext(self.clock, {"arm": arm}, self.scene, seed))
        assert isinstance(tip, SimTactip)
        self.tip = tip
        for device in (arm, tip):
            device.connect()
            device.configure()
            device.activate()
        self.lease = arm.acquire("test")

    def move(self, vz_m_s: float, seconds: float) -> None:
        for _ in range(round(seconds / 0.01)):
            twist = np.array([0, 0, vz_m_s, 0, 0, 0.0])
            self.arm.send_twist(TwistCommand(twist, TwistFrame.TCP, self.clock.now_ns(), 0.02), self.lease)
            self.clock.advance_s(0.01)


def test_the_spec_matches_the_device() -> None:
    cell = Cell()
    assert DRIVERS.load("sim_tactip").capabilities.provides == {FrameSource, HealthSource}
    assert isinstance(cell.tip, FrameSource)
    assert isinstance(cell.tip, HealthSource)


def test_frames_are_stamped_at_capture_on_the_grid_of_the_clock() -> None:
    cell = Cell(latency_ms=15)
    frame = cell.tip.next(-1, timeout_s=1.0)
    assert (frame.seq, frame.t_ns) == (0, 0)
    assert cell.clock.now_ns() == 15_000_000
    frame = cell.tip.next(frame.seq, timeout_s=1.0)
    assert (frame.seq, frame.t_ns) == (1, 20_000_000)
    assert cell.clock.now_ns() == 35_000_000
    cell.clock.advance_s(0.1)
    frame = cell.tip.next(frame.seq, timeout_s=1.0)
    assert (frame.seq, frame.t_ns) == (6, 120_000_000)


def test_frames_are_drawn_only_when_read_and_only_once() -> None:
    cell = Cell()
    cell.clock.advance_s(2.0)
    cell.arm.tcp()
    assert cell.tip.health()["frames_drawn"] == 0
    first = cell.tip.latest()
    assert cell.tip.latest() is first
    assert cell.tip.next(first.seq - 1, 1.0) is first
    assert cell.tip.health()["frames_drawn"] == 1
    assert not first.value.image.flags.writeable


def test_the_image_shows_the_contact_of_its_stamp_not_of_its_reading() -> None:
    early, late = Cell(noise=0, latency_ms=0), Cell(noise=0, latency_ms=0)
    for cell in (early, late):
        cell.move(0.05, 0.12)
    at_once = early.tip.next(5, 1.0)
    assert at_once.t_ns == 120_000_000
    late.move(0.05, 0.01)
    assert late.scene.contact("tip").value.depth_m > early.scene.contact("tip").value.depth_m
    delayed = late.tip.latest()
    assert delayed.t_ns == at_once.t_ns
    np.testing.assert_array_equal(at_once.value.image, delayed.value.image)


def test_pressing_changes_the_picture_and_lifting_restores_it() -> None:
    cell = Cell(noise=0)
    free = cell.tip.latest().value.image
    assert free.shape == (480, 640)
    cell.move(0.05, 0.2)
    cell.move(0.0, 0.3)
    pressed = cell.tip.latest().value.image
    assert cell.scene.contact("tip").value.depth_m == pytest.approx(0.005, abs=5e-4)
    assert (free != pressed).mean() > 0.1
    cell.move(-0.05, 0.25)
    cell.move(0.0, 0.3)
    np.testing.assert_array_equal(cell.tip.latest().value.image, free)


def test_the_same_seed_gives_the_same_frames() -> None:
    images = []
    for seed, name in ((4, "tip"), (4, "tip"), (5, "tip"), (4, "other")):
        cell = Cell(seed, name)
        cell.move(0.05, 0.15)
        images.append(cell.tip.next(3, 1.0).value.image)
    np.testing.assert_array_equal(images[0], images[1])
    assert (images[0] != images[2]).any()
    assert (images[0] != images[3]).any()


def test_processed_output_is_binary_and_of_the_public_size() -> None:
    image = Cell(output="processed").tip.latest().value.image
    assert image.shape == (440, 445)
    assert set(np.unique(image)) == {0, 255}


def test_a_frame_that_comes_too_late_is_a_timeout() -> None:
    cell = Cell(rate_hz=2, latency_ms=0)
    cell.clock.advance_s(0.1)
    with pytest.raises(TransportTimeout) as caught:
        cell.tip.next(0, timeout_s=0.3)
    assert caught.value.timeout_s == 0.3
    assert cell.clock.now_ns() == 400_000_000
    with pytest.raises(StaleData) as stale:
        cell.tip.latest(max_age_s=0.3)
    assert stale.value.age_s == pytest.approx(0.4)
    assert cell.tip.health()["frames_drawn"] == 0


def test_a_disconnected_sensor_delivers_nothing() -> None:
    cell = Cell()
    cell.tip.disconnect()
    with pytest.raises(LifecycleError):
        cell.tip.latest()
    with pytest.raises(LifecycleError):
        cell.tip.next(-1, 1.0)


def test_a_frozen_camera_keeps_counting_but_shows_the_past() -> None:
    cell = Cell()
    last = cell.tip.next(2, 1.0)
    cell.tip.faults = FrameFaults(frozen=True)
    cell.move(0.05, 0.15)
    frozen = cell.tip.next(last.seq, 1.0)
    assert frozen.seq > last.seq
    assert frozen.t_ns > last.t_ns
    np.testing.assert_array_equal(frozen.value.image, last.value.image)
    cell.tip.faults = FrameFaults()
    assert (cell.tip.next(frozen.seq, 1.0).value.image != last.value.image).any()


def test_a_silent_camera_goes_stale() -> None:
    cell = Cell(latency_ms=0)
    cell.tip.faults = FrameFaults(last_seq=2)
    assert cell.tip.next(1, 1.0).seq == 2
    with pytest.raises(TransportTimeout):
        cell.tip.next(2, 0.5)
    with pytest.raises(StaleData):
        cell.tip.latest(max_age_s=0.1)


def test_a_late_camera_delivers_old_frames() -> None:
    cell = Cell(latency_ms=0)
    cell.tip.faults = FrameFaults(extra_latency_s=0.1)
    cell.clock.advance_s(0.5)
    assert cell.tip.latest().t_ns == 400_000_000


def test_it_needs_a_scene_and_a_simulated_arm() -> None:
    cell = Cell()
    spec = DRIVERS.load("sim_tactip")
    config = SimTactipConfig(mounted_on="arm")
    with pytest.raises(ConfigError, match="needs a scene"):
        spec.build("tip2", config, DriverContext(cell.clock, {"arm": cell.arm}))
    with pytest.raises(ConfigError, match="not an arm of this cell") as caught:
        spec.build("tip2", config, DriverContext(cell.clock, {"tip": cell.tip}, cell.scene))
    assert caught.value.key == "tip2.mounted_on"


@pytest.mark.parametrize(
    "changes", [{"rate_hz": 0}, {"latency_ms": -1}, {"noise": float("nan")}, {"output": "jpeg"}, {"fps": 30}], ids=str
)
def test_senseless_configuration_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SimTactipConfig.model_validate({"mounted_on": "arm", **changes})


def test_a_snapshot_takes_arm_contact_and_picture_back() -> None:
    cell = Cell()
    cell.move(0.02, 0.2)
    restore, pose = cell.scene.snapshot(), cell.arm.T_world_tcp()
    cell.move(0.02, 0.2)
    deep = cell.tip.latest().value.image
    arrived = cell.arm.T_world_tcp()
    restore()
    np.testing.assert_array_equal(cell.arm.T_world_tcp(), pose)
    assert np.abs(cell.tip.latest().value.image.astype(int) - deep.astype(int)).max() > 100
    cell.move(0.02, 0.2)
    cell.scene.timeline.advance()
    np.testing.assert_allclose(cell.arm.T_world_tcp(), arrived, atol=1e-12)


DOWN = se3.from_euler_mm_deg([400, 0, 0, 180, 0, 0])


class Told:
    """An arm that returns a given state, or raises that it is lost."""

    def __init__(self) -> None:
        self.z_m: float | None = None

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        if self.z_m is None:
            raise DeviceGone("arm", "cable")
        T = DOWN.copy()
        T[2, 3] = self.z_m
        return Stamped(TcpState(T, np.zeros(6)), 0, 0)


def test_a_simulated_sensor_can_be_mounted_on_any_arm_with_a_pose() -> None:
    clock, arm = VirtualClock(), Told()
    scene: Scene = SceneConfig.model_validate({"surfaces": {"table": {"kind": "plane"}}}).build(clock)
    config = SimTactipConfig(mounted_on="arm", rate_hz=50, latency_ms=0)
    tip = DRIVERS.load("sim_tactip").build("tip", config, DriverContext(clock, {"arm": arm}, scene, 0))  # type: ignore[dict-item]
    assert isinstance(tip, SimTactip)
    with pytest.raises(DeviceGone):
        tip.connect()
    clock.advance_s(0.1)
    arm.z_m = 0.025
    tip.connect()
    tip.configure()
    tip.activate()
    assert tip.next(-1, timeout_s=1.0).t_ns == 100_000_000
    assert scene.contact("tip").value.depth_m == pytest.approx(-0.005)
    for z_m, depth_m in ((0.017, 0.003), (float("nan"), 0.003), (None, 0.003)):
        arm.z_m = z_m
        clock.advance_s(0.01)
        assert scene.contact("tip").value.depth_m == pytest.approx(depth_m)


def test_dropped_frames_never_arrive_and_are_the_same_for_the_same_seed() -> None:
    def arrived(seed: int) -> list[int]:
        cell = Cell(seed=seed, dropped=0.3, latency_ms=0)
        seqs = [cell.tip.next(-1, 1.0).seq]
        while seqs[-1] < 100:
            seqs.append(cell.tip.next(seqs[-1], 1.0).seq)
        return seqs

    first = arrived(1)
    assert first == arrived(1) != arrived(2)
    assert 0.55 < len(first) / 101 < 0.85
    cell = Cell(seed=1, dropped=0.3, latency_ms=0)
    cell.clock.advance_s(2.0)
    assert cell.tip.latest().seq == max(seq for seq in first if seq <= 100)


def test_exposure_and_blur_show_in_the_image() -> None:
    plain, bright, soft = (
        Cell(noise=0, **changes).tip.next(-1, 1.0).value.image.astype(float)
        for changes in ({}, {"exposure": 1.3}, {"blur_px": 2.0})
    )
    np.testing.assert_allclose(bright, np.minimum(1.3 * plain, 255), atol=2)
    assert bright.max() > plain.max()
    assert np.abs(np.diff(soft, axis=1)).max() < 0.5 * np.abs(np.diff(plain, axis=1)).max()
    assert soft.mean() == pytest.approx(plain.mean(), abs=1.0)


def test_a_tip_file_makes_another_sensor() -> None:
    plain, other = (Cell(noise=0, **changes).tip.next(-1, 1.0).value.image for changes in ({}, TIP_FILE))
    assert (plain != other).mean() > 0.01
    with pytest.raises(ConfigError):
        Cell(tip="nobody.yaml")


TIP_FILE = {"tip": "franka_tactip_1"}
