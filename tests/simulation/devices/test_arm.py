import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, LifecycleError, Rejection, StaleData
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.core.protocols import HealthSource, StopCategory, Stoppable, TcpSource, TwistSink
from touchcell.drivers.core.spec import DRIVERS, DriverContext
from touchcell.geometry import se3
from touchcell.simulation.devices.arm import SimArm, SimArmConfig
from touchcell.simulation.faults import ArmFaults

START = (400.0, 0.0, 300.0, 180.0, 0.0, 0.0)


def make(clock: VirtualClock, **changes: object) -> SimArm:
    config = SimArmConfig.model_validate({"start_pose_mm_deg": START, **changes})
    arm = DRIVERS.load("sim_arm").build("arm", config, DriverContext(clock))
    assert isinstance(arm, SimArm)
    return arm


def active(clock: VirtualClock, **changes: object) -> tuple[SimArm, Lease]:
    arm = make(clock, **changes)
    arm.connect()
    arm.configure()
    arm.activate()
    return arm, arm.acquire("test")


def send(
    arm: SimArm,
    lease: Lease,
    clock: VirtualClock,
    twist: list[float],
    ttl_s: float = 0.1,
    frame: TwistFrame = TwistFrame.BASE,
) -> None:
    arm.send_twist(TwistCommand(np.array(twist), frame, clock.now_ns(), ttl_s), lease)


def get_going(arm: SimArm, lease: Lease, clock: VirtualClock, twist: list[float]) -> None:
    """Stream ``twist`` until the gate lets all of it through: the first command from rest is a small one."""
    for _ in range(50):
        send(arm, lease, clock, twist)
        clock.advance_s(0.01)


def test_the_spec_matches_the_device() -> None:
    spec = DRIVERS.load("sim_arm")
    arm = make(VirtualClock())
    for protocol in (TcpSource, TwistSink, Stoppable, HealthSource):
        assert isinstance(arm, protocol)
        assert protocol in spec.capabilities.provides
    assert len(spec.capabilities.provides) == 4


def test_it_starts_at_the_configured_pose_and_can_be_read_while_passive() -> None:
    clock = VirtualClock()
    arm = make(clock, base_pose_mm_deg=(0, 100, 0, 0, 0, 90))
    with pytest.raises(LifecycleError):
        arm.tcp()
    arm.connect()
    np.testing.assert_allclose(arm.tcp().value.T_base_tcp, se3.from_euler_mm_deg(START))
    np.testing.assert_allclose(arm.T_world_tcp()[:3, 3], [0.0, 0.5, 0.3], atol=1e-15)
    assert arm.at_rest()


def test_a_stream_of_twists_moves_by_speed_times_time() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    for _ in range(200):
        send(arm, lease, clock, [0.05, 0, 0, 0, 0, 0.2])
        clock.advance_s(0.01)
    state = arm.tcp().value
    np.testing.assert_allclose(state.twist, [0.05, 0, 0, 0, 0, 0.2], atol=1e-12)
    # The first cycle, and 0.1 s or 0.08 s for the turn after it, went into accelerating at a constant rate.
    assert state.T_base_tcp[0, 3] == pytest.approx(0.4 + 0.05 * (2.0 - 0.01 - 0.05), abs=2e-4)
    turned = se3.log(state.T_base_tcp @ se3.inverse(se3.from_euler_mm_deg(START)))[5]
    assert turned == pytest.approx(0.2 * (2.0 - 0.01 - 0.04), abs=2e-3)


def test_twists_along_tool_axes_follow_the_tool() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    for _ in range(100):
        send(arm, lease, clock, [0, 0, 0.05, 0, 0, 0], frame=TwistFrame.TCP)
        clock.advance_s(0.01)
    # The tool points down.
    assert arm.tcp().value.T_base_tcp[2, 3] < 0.3 - 0.04
    assert arm.tcp().value.T_base_tcp[0, 3] == pytest.approx(0.4)


@settings(max_examples=30)
@given(
    twist=st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6),
    ttl_s=st.floats(0.02, 0.3),
)
def test_silence_stops_it_within_the_declared_time(twist: list[float], ttl_s: float) -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    send(arm, lease, clock, twist, ttl_s)
    braking_s = max(
        arm.limits.speed_m_s / arm.limits.accel_m_s2, arm.limits.rot_speed_rad_s / arm.limits.rot_accel_rad_s2
    )
    clock.advance_s(ttl_s + braking_s + 0.004)
    assert arm.at_rest()
    resting = arm.tcp().value.T_base_tcp
    clock.advance_s(1.0)
    np.testing.assert_array_equal(arm.tcp().value.T_base_tcp, resting)


def test_it_keeps_moving_until_the_time_to_live_is_over() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    get_going(arm, lease, clock, [0.05, 0, 0, 0, 0, 0])
    send(arm, lease, clock, [0.05, 0, 0, 0, 0, 0], 0.5)
    clock.advance_s(0.498)
    assert arm.tcp().value.twist[0] == pytest.approx(0.05)
    assert not arm.at_rest()


def test_acceleration_never_exceeds_the_limits() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    rng = np.random.default_rng(0)
    before = np.zeros(6)
    for step in range(500):
        if step % 5 == 0:
            send(arm, lease, clock, list(rng.uniform(-1, 1, 6)))
        clock.advance_s(0.002)
        now = arm.tcp().value.twist
        assert np.linalg.norm(now[:3] - before[:3]) <= 0.5 * 0.002 + 1e-12
        assert np.linalg.norm(now[3:] - before[3:]) <= 2.5 * 0.002 + 1e-12
        assert np.linalg.norm(now[:3]) <= 0.10 + 1e-12
        before = now
    R = arm.tcp().value.T_base_tcp[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)


def test_its_path_does_not_depend_on_when_it_is_read() -> None:
    ends = []
    for polls in (1, 7):
        clock = VirtualClock()
        arm, lease = active(clock)
        for _ in range(20):
            send(arm, lease, clock, [0.05, 0.02, 0, 0.1, 0, 0.2], 0.015)
            for _ in range(polls):
                clock.advance_s(0.021 / polls)
                arm.tcp()
        ends.append(arm.tcp().value.T_base_tcp)
    np.testing.assert_array_equal(ends[0], ends[1])


@pytest.mark.parametrize("category", [StopCategory.STOP_AND_HOLD, StopCategory.STOP_THEN_REMOVE_POWER])
def test_stops_brake_at_the_acceleration_limit(category: StopCategory) -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    get_going(arm, lease, clock, [0.1, 0, 0, 0, 0, 0])
    x = arm.tcp().value.T_base_tcp[0, 3]
    arm.stop(category)
    assert not arm.at_rest()
    clock.advance_s(0.202)
    assert arm.at_rest()
    assert arm.tcp().value.T_base_tcp[0, 3] - x == pytest.approx(0.1**2 / (2 * 0.5), rel=1e-6)
    assert arm.state is (Lifecycle.ACTIVE if category == 2 else Lifecycle.READY)


def test_nan_and_foreign_leases_do_not_move_it() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    with pytest.raises(CommandRejected) as caught:
        send(arm, lease, clock, [float("nan"), 0, 0, 0, 0, 0])
    assert caught.value.reason is Rejection.NON_FINITE
    with pytest.raises(CommandRejected) as caught:
        send(arm, Lease("arm", "test", 1), clock, [0.1, 0, 0, 0, 0, 0])
    assert caught.value.reason is Rejection.LEASE
    clock.advance_s(0.5)
    assert arm.at_rest()
    np.testing.assert_array_equal(arm.tcp().value.T_base_tcp, arm.T_world_tcp())


def test_deactivation_and_disconnection_leave_it_standing() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    send(arm, lease, clock, [0.1, 0, 0, 0, 0, 0], 1.0)
    clock.advance_s(0.5)
    arm.disconnect()
    stood = arm.T_world_tcp()
    clock.advance_s(0.5)
    arm.connect()
    np.testing.assert_array_equal(arm.tcp().value.T_base_tcp, stood)


def test_a_pose_that_is_not_a_number_turns_no_twist() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    arm.faults = ArmFaults(nan_state=True)
    assert np.isnan(arm.tcp().value.T_base_tcp).all()
    with pytest.raises(CommandRejected) as caught:
        send(arm, lease, clock, [0.1, 0, 0, 0, 0, 0], frame=TwistFrame.TCP)
    assert caught.value.reason is Rejection.NON_FINITE


def test_an_arm_deaf_to_stops_still_stops_when_its_command_expires() -> None:
    clock = VirtualClock()
    arm, lease = active(clock)
    get_going(arm, lease, clock, [0.1, 0, 0, 0, 0, 0])
    send(arm, lease, clock, [0.1, 0, 0, 0, 0, 0], 0.3)
    clock.advance_s(0.2)
    arm.faults = ArmFaults(ignores_stops=True)
    arm.stop()
    clock.advance_s(0.09)
    assert arm.tcp().value.twist[0] == pytest.approx(0.1)
    clock.advance_s(0.3)
    assert arm.at_rest()


def test_state_is_fresh_to_one_step_and_stamped_accordingly() -> None:
    clock = VirtualClock()
    arm, _ = active(clock)
    clock.advance_s(0.0011)
    sample = arm.tcp(max_age_s=0.002)
    assert sample.t_ns == 0
    with pytest.raises(StaleData):
        arm.tcp(max_age_s=0.001)


@pytest.mark.parametrize(
    "changes",
    [
        {"limits": {"tcp_speed_m_s": 0}},
        {"limits": {"tcp_accel_m_s2": float("nan")}},
        {"limits": {"tcp_speed": 0.1}},
        {"start_pose_mm_deg": (0, 0, 0, 0, 0)},
        {"start_pose_mm_deg": (0, 0, 0, 0, 0, float("inf"))},
        {"speed": 1},
        {"max_ttl_s": 0},
    ],
    ids=str,
)
def test_senseless_configuration_is_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        make(VirtualClock(), **changes)


def test_twists_reach_a_late_arm_late_and_stops_at_once() -> None:
    clock = VirtualClock()
    arm, lease = active(clock, latency_ms=40)
    prompt, prompt_lease = active(clock)
    for each, its in ((arm, lease), (prompt, prompt_lease)):
        send(each, its, clock, [0.05, 0, 0, 0, 0, 0], ttl_s=0.2)
    assert not arm.at_rest()
    moved = []
    for _ in range(60):
        clock.advance_s(0.01)
        moved.append([each.tcp().value.T_base_tcp[0, 3] - 0.4 for each in (arm, prompt)])
    late, at_once = np.array(moved).T
    np.testing.assert_allclose(late[:4], 0.0, atol=1e-12)
    # Its motion is delayed by 40 ms, to the end of the time-to-live.
    np.testing.assert_allclose(late[4:], at_once[:-4], atol=1e-12)
    send(arm, lease, clock, [0.05, 0, 0, 0, 0, 0])
    arm.stop()
    clock.advance_s(0.3)
    assert arm.tcp().value.T_base_tcp[0, 3] - 0.4 == pytest.approx(late[-1], abs=1e-12)
