import math

import numpy as np
import pytest

from touchcell.drivers.core.arm import Arm, LimitsConfig
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import DeactivatePolicy, Lifecycle
from touchcell.drivers.core.errors import (
    CommandRejected,
    DeviceFault,
    FaultClass,
    LifecycleError,
    Rejection,
    StaleData,
    TransportError,
)
from touchcell.drivers.core.gate import FIRST_STEP_S
from touchcell.drivers.core.protocols import StopCategory, Stoppable, TcpSource, TwistSink
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain


class NotedArm(Arm):
    """Writes down what reaches it; needs ``rest_after_s`` to stop."""

    def __init__(self, clock: VirtualClock, rest_after_s: float = 0.1) -> None:
        super().__init__("arm", clock, LimitsConfig().build(), stop_categories=(1, 2), max_ttl_s=0.5)
        self.streamed: list[tuple[np.ndarray, float]] = []
        self.stops: list[int] = []
        self.policies: list[DeactivatePolicy] = []
        self.T_base_tcp = np.eye(4)
        self.pose_age_ns = 0
        self._rest_after_ns = round(rest_after_s * 1e9)
        self._rest_ns = 0

    def tcp(self, max_age_s: float | None = None) -> Stamped[TcpState]:
        now_ns = self._clock.now_ns()
        sample = Stamped(TcpState(self.T_base_tcp, np.zeros(6)), now_ns - self.pose_age_ns, 0)
        if max_age_s is not None and sample.age_s(now_ns) > max_age_s:
            raise StaleData(self.name, sample.age_s(now_ns), max_age_s, 0)
        return sample

    def at_rest(self) -> bool:
        return self._clock.now_ns() >= self._rest_ns

    def fail(self) -> None:
        def step() -> None:
            raise TransportError(self.name, "the cable is out")

        self._attempt(step)

    def _stream_twist(self, twist_base: np.ndarray, ttl_s: float, now_ns: int) -> None:
        self.streamed.append((twist_base, ttl_s))

    def _begin_stop(self, category: StopCategory) -> None:
        self.stops.append(int(category))
        self._rest_ns = self._clock.now_ns() + self._rest_after_ns

    def _after_rest(self, policy: DeactivatePolicy) -> None:
        self.policies.append(policy)

    def _open(self) -> None:
        pass

    def _close(self) -> None:
        pass


@pytest.fixture
def clock() -> VirtualClock:
    return VirtualClock(5_000_000_000)


@pytest.fixture
def arm(clock: VirtualClock) -> NotedArm:
    arm = NotedArm(clock)
    arm.connect()
    arm.configure()
    arm.activate()
    return arm


def command(
    clock: VirtualClock, vx: float = 0.01, frame: TwistFrame = TwistFrame.BASE, ttl_s: float = 0.1
) -> TwistCommand:
    return TwistCommand(np.array([vx, 0, 0, 0, 0, 0.0]), frame, clock.now_ns(), ttl_s)


def test_it_provides_the_protocols_of_an_arm(arm: NotedArm) -> None:
    assert isinstance(arm, TcpSource)
    assert isinstance(arm, TwistSink)
    assert isinstance(arm, Stoppable)


def test_an_admitted_twist_reaches_the_device_with_what_is_left_of_its_time(arm: NotedArm, clock: VirtualClock) -> None:
    lease = arm.acquire("task")
    for _ in range(10):
        arm.send_twist(command(clock), lease)
        clock.advance_s(0.01)
    late = command(clock)
    clock.advance_s(0.03)
    sent = arm.send_twist(late, lease)
    twist, ttl_s = arm.streamed[-1]
    np.testing.assert_array_equal(twist, [0.01, 0, 0, 0, 0, 0])
    assert ttl_s == pytest.approx(0.07)
    assert not sent.limited
    assert arm.owner == "task"


def test_a_twist_along_tool_axes_is_turned_to_base_axes(arm: NotedArm, clock: VirtualClock) -> None:
    arm.T_base_tcp = np.array([[0, -1, 0, 0.4], [1, 0, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
    lease = arm.acquire("task")
    for _ in range(10):
        sent = arm.send_twist(command(clock, frame=TwistFrame.TCP), lease)
        clock.advance_s(0.01)
    np.testing.assert_allclose(arm.streamed[-1][0], [0, 0.01, 0, 0, 0, 0], atol=1e-15)
    assert sent.command.frame is TwistFrame.BASE


def test_excess_speed_is_cut_and_named(arm: NotedArm, clock: VirtualClock) -> None:
    lease = arm.acquire("task")
    for _ in range(40):
        sent = arm.send_twist(command(clock, vx=5.0, ttl_s=0.5), lease)
        clock.advance_s(0.01)
    assert np.linalg.norm(arm.streamed[-1][0][:3]) == pytest.approx(0.10)
    assert [adjustment.limit for adjustment in sent.adjustments] == ["tcp linear speed"]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("axis", range(6))
def test_nothing_that_is_not_finite_reaches_the_device(
    arm: NotedArm, clock: VirtualClock, bad: float, axis: int
) -> None:
    lease = arm.acquire("task")
    twist = np.zeros(6)
    twist[axis] = bad
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(TwistCommand(twist, TwistFrame.BASE, clock.now_ns(), 0.1), lease)
    assert caught.value.reason is Rejection.NON_FINITE
    assert arm.streamed == []


def test_a_pose_that_is_not_finite_or_fresh_turns_nothing(arm: NotedArm, clock: VirtualClock) -> None:
    lease = arm.acquire("task")
    arm.T_base_tcp = np.full((4, 4), math.nan)
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock, frame=TwistFrame.TCP), lease)
    assert caught.value.reason is Rejection.NON_FINITE
    arm.T_base_tcp = np.eye(4)
    arm.pose_age_ns = 200_000_000
    with pytest.raises(StaleData):
        arm.send_twist(command(clock, frame=TwistFrame.TCP), lease)
    assert arm.streamed == []


def test_joints_that_are_not_finite_limit_nothing_and_are_refused(arm: NotedArm, clock: VirtualClock) -> None:
    lease = arm.acquire("task")
    ik = DifferentialIk(SerialChain(ChainDescription.shipped("generic_6r")))
    arm._local_ik = lambda: arm._ik_at(ik, np.full(6, math.nan))  # type: ignore[method-assign]
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock), lease)
    assert caught.value.reason is Rejection.NON_FINITE
    assert arm.streamed == []


def test_only_the_leases_owner_may_command(arm: NotedArm, clock: VirtualClock) -> None:
    old = arm.acquire("first")
    with pytest.raises(CommandRejected) as caught:
        arm.acquire("second")
    assert caught.value.reason is Rejection.LEASE
    arm.release(old)
    arm.acquire("second")
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock), old)
    assert caught.value.reason is Rejection.LEASE
    assert arm.streamed == []


def test_releasing_stops_the_arm_but_a_void_lease_does_not(arm: NotedArm) -> None:
    old = arm.acquire("first")
    arm.release(old)
    assert arm.stops == [2]
    arm.acquire("second")
    arm.release(old)
    assert arm.stops == [2]
    assert arm.owner == "second"


@pytest.mark.parametrize("age_s", [0.11, -0.01])
def test_expired_and_future_commands_are_refused(arm: NotedArm, clock: VirtualClock, age_s: float) -> None:
    lease = arm.acquire("task")
    stale = TwistCommand(np.zeros(6), TwistFrame.BASE, clock.now_ns() - round(age_s * 1e9), 0.1)
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(stale, lease)
    assert caught.value.reason is Rejection.EXPIRED


def test_an_arm_that_is_not_active_takes_no_twist(clock: VirtualClock) -> None:
    arm = NotedArm(clock)
    lease = arm.acquire("task")
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock, frame=TwistFrame.TCP), lease)
    assert caught.value.reason is Rejection.MODE


def test_after_a_stop_the_next_twist_starts_from_rest(arm: NotedArm, clock: VirtualClock) -> None:
    lease = arm.acquire("task")
    for _ in range(40):
        arm.send_twist(command(clock, vx=0.1, ttl_s=0.5), lease)
        clock.advance_s(0.01)
    assert arm.streamed[-1][0][0] == pytest.approx(0.1)
    arm.stop()
    clock.advance_s(0.01)
    arm.send_twist(command(clock, vx=0.1, ttl_s=0.02), lease)
    assert 0.0 < arm.streamed[-1][0][0] <= 0.5 * FIRST_STEP_S


def test_deactivation_voids_the_lease_waits_for_rest_then_applies_the_policy(
    arm: NotedArm, clock: VirtualClock
) -> None:
    lease = arm.acquire("task")
    began_ns = clock.now_ns()
    arm.deactivate(DeactivatePolicy.BRAKE)
    assert arm.stops == [2]
    assert arm.policies == [DeactivatePolicy.BRAKE]
    assert clock.now_ns() - began_ns >= 100_000_000
    assert arm.owner is None
    with pytest.raises(CommandRejected):
        arm.send_twist(command(clock), lease)


def test_an_arm_that_does_not_come_to_rest_is_faulted(clock: VirtualClock) -> None:
    arm = NotedArm(clock, rest_after_s=60.0)
    arm.connect()
    arm.configure()
    arm.activate()
    with pytest.raises(DeviceFault) as caught:
        arm.deactivate()
    assert caught.value.fault_class is FaultClass.MOTION
    assert arm.state is Lifecycle.FAULTED
    assert arm.policies == []


def test_a_fault_stops_and_voids_the_lease(arm: NotedArm) -> None:
    arm.acquire("task")
    with pytest.raises(TransportError):
        arm.fail()
    assert arm.state is Lifecycle.FAULTED
    assert arm.stops == [2]
    assert arm.owner is None


def test_category_1_ends_in_ready_without_an_owner(arm: NotedArm) -> None:
    arm.acquire("task")
    arm.stop(StopCategory.STOP_THEN_REMOVE_POWER)
    assert arm.stops == [1]
    assert arm.state is Lifecycle.READY
    assert arm.owner is None


def test_a_category_that_is_not_offered_is_refused(arm: NotedArm) -> None:
    with pytest.raises(LifecycleError) as caught:
        arm.stop(StopCategory.REMOVE_POWER)
    assert caught.value.allowed == ("category 1", "category 2")
    assert arm.stops == []


def test_disconnecting_an_active_arm_stops_it(arm: NotedArm) -> None:
    arm.acquire("task")
    arm.disconnect()
    assert arm.stops == [2]
    assert arm.owner is None
    arm.stop()
    assert arm.stops == [2]


@pytest.mark.parametrize("value", [0.0, -0.1, math.nan, math.inf])
def test_limits_are_positive_and_finite(value: float) -> None:
    for key in ("tcp_speed_m_s", "tcp_accel_m_s2", "tcp_rot_speed_rad_s", "tcp_rot_accel_rad_s2"):
        with pytest.raises(ValueError, match=key):
            LimitsConfig(**{key: value})


def test_an_arm_without_an_owner_rejects_commands(arm: NotedArm, clock: VirtualClock) -> None:
    def assert_refused() -> None:
        with pytest.raises(CommandRejected) as caught:
            arm.send_twist(command(clock), None)  # type: ignore[arg-type]
        assert caught.value.reason is Rejection.LEASE
        assert arm.streamed == []

    assert_refused()
    arm.release(arm.acquire("task"))
    assert_refused()
    arm.acquire("task")
    arm.stop(StopCategory.STOP_THEN_REMOVE_POWER)
    arm.activate()
    assert_refused()


def test_what_reaches_the_device_cannot_be_written_to(arm: NotedArm, clock: VirtualClock) -> None:
    arm.send_twist(command(clock), arm.acquire("task"))
    with pytest.raises(ValueError, match="read-only"):
        arm.streamed[0][0][0] = math.nan


@pytest.mark.parametrize("faulted", [False, True], ids=["stopped", "faulted"])
def test_an_arm_stopped_while_a_twist_is_on_its_way_is_stopped_once_more_and_the_twist_refused(
    clock: VirtualClock, faulted: bool
) -> None:
    class Interrupted(NotedArm):
        """Is stopped by another thread between the gate and the device."""

        def _stream_twist(self, twist_base: np.ndarray, ttl_s: float, now_ns: int) -> None:
            if faulted:
                with pytest.raises(TransportError):
                    self.fail()
            else:
                self.stop()
            super()._stream_twist(twist_base, ttl_s, now_ns)
            self.stops.append(-1)

    arm = Interrupted(clock)
    arm.connect()
    arm.configure()
    arm.activate()
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock), arm.acquire("task"))
    assert caught.value.reason is Rejection.MODE
    assert arm.stops == [2, -1, 2], "the stop comes after the twist as well"


@pytest.mark.parametrize("goal", [None, "home", [[0.0]], [1.0, "x"], np.zeros(5), [True] * 6])
def test_a_joint_goal_of_another_kind_is_refused_as_such(arm: NotedArm, goal: object) -> None:
    lease = arm.acquire("task")
    with pytest.raises(CommandRejected) as caught:
        arm._admitted_joint_goal(goal, lease, 0.1, -1.0, 1.0, 6)  # type: ignore[arg-type]
    assert caught.value.reason is Rejection.SHAPE
    with pytest.raises(CommandRejected) as caught:
        arm._admitted_joint_goal(np.zeros(6), lease, "fast", -1.0, 1.0, 6)  # type: ignore[arg-type]
    assert caught.value.reason is Rejection.NON_FINITE


def test_a_joint_goal_is_refused_in_the_order_of_a_twist_and_returned_as_numbers(arm: NotedArm) -> None:
    lease = arm.acquire("task")

    def reason(q: object, lease: object = lease, speed: float = 0.1) -> Rejection:
        with pytest.raises(CommandRejected) as caught:
            arm._admitted_joint_goal(q, lease, speed, -1.0, 1.0, 6)  # type: ignore[arg-type]
        return caught.value.reason

    assert reason([math.nan] * 6, None) is Rejection.NON_FINITE
    assert reason([0.0] * 6, None) is Rejection.LEASE
    assert reason([0.0] * 5 + [1.01]) is Rejection.LIMIT
    assert reason([-1.01] + [0.0] * 5) is Rejection.LIMIT
    assert reason([0.0] * 6, speed=0.0) is Rejection.LIMIT
    assert reason([0.0] * 6, speed=1.01) is Rejection.LIMIT
    np.testing.assert_array_equal(arm._admitted_joint_goal([1] * 6, lease, 1.0, -1.0, 1.0, 6), np.ones(6))
    arm._state = Lifecycle.READY
    assert reason([0.0] * 6) is Rejection.MODE


def test_a_stop_that_removes_power_does_not_overwrite_a_fault(arm: NotedArm, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = DeviceFault("arm", "brake")
    begin_stop = arm._begin_stop

    def faulting(category: StopCategory) -> None:
        begin_stop(category)
        arm._to_faulted(fault)

    monkeypatch.setattr(arm, "_begin_stop", faulting)
    arm.stop(StopCategory.STOP_THEN_REMOVE_POWER)
    assert arm.state is Lifecycle.FAULTED
    assert arm.fault is fault


def test_a_twist_that_meets_a_fault_is_followed_by_a_stop(
    clock: VirtualClock, arm: NotedArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    lease = arm.acquire("task")
    happened: list[str] = []
    begin_stop = arm._begin_stop

    def streamed(twist_base: np.ndarray, ttl_s: float, now_ns: int) -> None:
        # A thread of the driver latches a fault, and its stop reaches the arm before this twist does.
        arm._to_faulted(DeviceFault("arm", "hot"))
        happened.append("twist")

    def stopped(category: StopCategory) -> None:
        begin_stop(category)
        happened.append("stop")

    monkeypatch.setattr(arm, "_stream_twist", streamed)
    monkeypatch.setattr(arm, "_begin_stop", stopped)
    with pytest.raises(CommandRejected) as caught:
        arm.send_twist(command(clock), lease)
    assert caught.value.reason is Rejection.MODE
    assert happened == ["stop", "twist", "stop"]
    assert arm.state is Lifecycle.FAULTED
