"""Rejections of the gate and their order; accepted commands are copies: finite, limited and read-only."""

from __future__ import annotations

import math
import threading
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as numpy_strategies

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.command_checks import checked_twist_command, finite_array
from touchcell.drivers.core.commands import Sent, TwistCommand, TwistFrame, read_only
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, Rejection
from touchcell.drivers.core.gate import FIRST_STEP_S, TwistGate, TwistLimits
from touchcell.drivers.core.lease import Lease, LeaseManager
from touchcell.drivers.kinematics.adjustment import Adjustment
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain
from touchcell.geometry.types import Array

LIMITS = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)
NO_JERK = replace(LIMITS, jerk_m_s3=1e12, rot_jerk_rad_s3=1e12)
FORWARD = np.array([0.1, 0, 0, 0, 0, 0])


class GateHarness:
    """A gate with its lease, and the command that would pass."""

    def __init__(self, limits: TwistLimits = LIMITS, max_ttl_s: float = 0.5, start_ns: int = 10**9) -> None:
        self.clock = VirtualClock(start_ns)
        self.desk = LeaseManager("arm")
        self.gate = TwistGate("arm", limits, self.desk, self.clock, max_ttl_s=max_ttl_s)
        self.lease: Any = self.desk.acquire("test")

    def send(
        self, twist: Any = FORWARD, *, state: Lifecycle = Lifecycle.ACTIVE, after_s: float = 0.01, **changes: Any
    ) -> Sent[TwistCommand]:
        self.clock.advance_s(after_s)
        command = replace(TwistCommand(twist, TwistFrame.BASE, self.clock.now_ns(), 0.1), **changes)
        return self.gate.admit(command, self.lease, state, np.eye(4))

    def refusal(self, twist: Any = FORWARD, **changes: Any) -> CommandRejected:
        with pytest.raises(CommandRejected) as caught:
            self.send(twist, **changes)
        return caught.value

    def cruise(self, twist: Array = FORWARD, cycles: int = 60) -> Sent[TwistCommand]:
        for _ in range(cycles):
            sent = self.send(twist)
        return sent


@pytest.fixture
def harness() -> GateHarness:
    return GateHarness()


# --- each reason, and their order


@pytest.mark.parametrize("shape", [(), (0,), (1,), (5,), (7,), (1, 6), (6, 1), (2, 3), (6, 6)])
def test_a_twist_of_another_shape_is_refused_with_the_shape_that_it_has(
    harness: GateHarness, shape: tuple[int, ...]
) -> None:
    refused = harness.refusal(np.zeros(shape))
    assert refused.reason is Rejection.SHAPE
    assert (refused.value, refused.limit) == (shape, (6,))


@pytest.mark.parametrize("frame", ["base", "tcp", None, 0, TwistFrame])
def test_a_frame_that_is_none_is_refused(harness: GateHarness, frame: Any) -> None:
    refused = harness.refusal(frame=frame)
    assert refused.reason is Rejection.FRAME
    assert refused.value is frame


@pytest.mark.parametrize("ttl_s", [0.0, -0.1, 0.5000001, 3.0, 1e6])
def test_a_time_to_live_outside_its_range_is_refused_with_the_longest(harness: GateHarness, ttl_s: float) -> None:
    refused = harness.refusal(ttl_s=ttl_s)
    assert refused.reason is Rejection.LIMIT
    assert (refused.value, refused.limit) == (ttl_s, 0.5)


def test_the_longest_time_to_live_is_accepted(harness: GateHarness) -> None:
    assert harness.send(ttl_s=0.5).command.ttl_s == 0.5


@pytest.mark.parametrize("ttl_s", [math.nan, math.inf, -math.inf, None, "0.1", [0.1, 0.2], 10**400])
def test_a_time_to_live_that_is_no_finite_number_is_refused(harness: GateHarness, ttl_s: Any) -> None:
    assert harness.refusal(ttl_s=ttl_s).reason is Rejection.NON_FINITE


@pytest.mark.parametrize("t_ns", [None, "now", math.nan, 1e9])
def test_a_time_stamp_that_is_no_whole_number_is_refused(harness: GateHarness, t_ns: Any) -> None:
    assert harness.refusal(t_ns=t_ns).reason is Rejection.EXPIRED


@pytest.mark.parametrize("t_ns", [10**400, -(10**400), 0])
def test_a_time_stamp_far_from_now_is_refused(harness: GateHarness, t_ns: int) -> None:
    assert harness.refusal(t_ns=t_ns).reason is Rejection.EXPIRED


def test_a_command_lives_to_the_end_of_its_time_and_not_a_nanosecond_longer(harness: GateHarness) -> None:
    now_ns = harness.clock.now_ns() + 10_000_000
    harness.send(t_ns=now_ns - 100_000_000)
    now_ns += 10_000_000
    assert harness.refusal(t_ns=now_ns - 100_000_001).reason is Rejection.EXPIRED
    now_ns += 10_000_000
    assert harness.refusal(t_ns=now_ns + 1).reason is Rejection.EXPIRED


def test_the_first_reason_in_the_documented_order_is_the_one_that_is_given(harness: GateHarness) -> None:
    wrong: dict[str, Any] = {"frame": "base", "ttl_s": 9.0, "t_ns": 0, "state": Lifecycle.READY}
    harness.lease = None
    assert harness.refusal(np.full(5, math.nan), **wrong).reason is Rejection.NON_FINITE
    assert harness.refusal(np.zeros(5), **wrong).reason is Rejection.SHAPE
    assert harness.refusal(**wrong).reason is Rejection.FRAME
    del wrong["frame"]
    assert harness.refusal(**wrong).reason is Rejection.LEASE
    harness.desk.revoke()
    harness.lease = harness.desk.acquire("test")
    assert harness.refusal(**wrong).reason is Rejection.MODE
    del wrong["state"]
    assert harness.refusal(**wrong).reason is Rejection.LIMIT
    del wrong["ttl_s"]
    assert harness.refusal(**wrong).reason is Rejection.EXPIRED


@pytest.mark.parametrize("state", [s for s in Lifecycle if s is not Lifecycle.ACTIVE])
def test_only_an_active_arm_takes_a_twist(harness: GateHarness, state: Lifecycle) -> None:
    assert harness.refusal(state=state).reason is Rejection.MODE


# --- the lease


@pytest.mark.parametrize("lease", [None, "test", 0, object()])
def test_a_wrong_lease_object_is_refused_whether_one_is_held_or_not(harness: GateHarness, lease: Any) -> None:
    held, harness.lease = harness.lease, lease
    assert harness.refusal().reason is Rejection.LEASE
    harness.desk.release(held)
    assert harness.refusal().reason is Rejection.LEASE
    harness.desk.revoke()
    assert harness.refusal().reason is Rejection.LEASE


def test_a_lease_equal_to_the_one_that_is_held_is_another_lease(harness: GateHarness) -> None:
    held = harness.lease
    harness.lease = Lease(held.device, held.owner, held.epoch)
    assert harness.lease == held
    assert harness.refusal().reason is Rejection.LEASE
    harness.desk.release(harness.lease)
    assert harness.desk.owner == "test", "a copy releases nothing either"


def test_no_two_leases_are_equal(harness: GateHarness) -> None:
    first = harness.lease
    harness.desk.revoke()
    second = harness.desk.acquire(first.owner)
    assert first != second
    harness.desk.release(first)
    assert harness.desk.owner == second.owner


def test_a_released_lease_is_nobodys_and_can_be_acquired_by_another(harness: GateHarness) -> None:
    harness.desk.release(harness.lease)
    assert harness.desk.owner is None
    assert harness.desk.acquire("other").owner == harness.desk.owner == "other"


def test_of_concurrent_threads_exactly_one_acquires_the_lease() -> None:
    desk = LeaseManager("arm")
    given_out: list[Lease] = []
    together = threading.Barrier(8)

    def ask(name: str) -> None:
        together.wait()
        with suppress(CommandRejected):
            given_out.append(desk.acquire(name))

    threads = [threading.Thread(target=ask, args=(str(k),)) for k in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [lease.owner for lease in given_out] == [desk.owner]


# --- every kind of array

AS_NUMBERS = {
    "list": lambda v: v.tolist(),
    "tuple": lambda v: tuple(v.tolist()),
    "float32": lambda v: v.astype(np.float32),
    "float16": lambda v: v.astype(np.float16),
    "long double": lambda v: v.astype(np.longdouble),
    "big-endian": lambda v: v.astype(">f8"),
    "not contiguous": lambda v: np.repeat(v, 3)[::3],
    "reversed view": lambda v: v[::-1].copy()[::-1],
    "read-only": lambda v: np.frombuffer(v.tobytes()),
    "subclass": lambda v: v.view(type("Sub", (np.ndarray,), {})),
    "masked, nothing masked": np.ma.masked_array,
}
NOT_NUMBERS = {
    "text": np.array(["0.1"] * 6),
    "list of text": ["0.1"] * 6,
    "booleans": np.zeros(6, bool),
    "complex": np.full(6, 0.1 + 0.1j),
    "objects": np.array([0.1] * 6, object),
    "None": None,
    "dates": np.zeros(6, "datetime64[s]"),
    "records": np.zeros(6, [("x", float)]),
    "ragged": [[0.1], 0.1, 0.1, 0.1, 0.1, 0.1],
    "dictionary": {"x": 0.1},
    "bytes": b"123456",
}


@pytest.mark.parametrize("kind", AS_NUMBERS)
def test_every_kind_of_array_of_six_numbers_is_accepted(harness: GateHarness, kind: str) -> None:
    twist = np.array([0.0625, -0.03125, 0.015625, 0.125, 0.25, -0.0625])
    for _ in range(60):
        sent = harness.send(AS_NUMBERS[kind](twist))
    np.testing.assert_array_equal(sent.command.twist, twist)
    assert sent.command.twist.dtype == np.float64
    assert type(sent.command.twist) is np.ndarray


def test_integers_are_taken_for_numbers(harness: GateHarness) -> None:
    for _ in range(60):
        sent = harness.send(np.array([1, 0, 0, 0, 0, 0], np.int8))
    np.testing.assert_array_equal(sent.command.twist, FORWARD)


@pytest.mark.parametrize("kind", NOT_NUMBERS)
def test_anything_but_an_array_of_numbers_is_refused(harness: GateHarness, kind: str) -> None:
    assert harness.refusal(NOT_NUMBERS[kind]).reason is Rejection.SHAPE


class Hostile:
    """Raises an unexpected error on conversion by NumPy."""

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise RuntimeError("no")


def test_an_object_that_raises_when_it_is_read_is_refused(harness: GateHarness) -> None:
    assert harness.refusal(Hostile()).reason is Rejection.SHAPE


def test_masked_elements_are_refused_although_numbers_lie_beneath(harness: GateHarness) -> None:
    masked = np.ma.masked_array(FORWARD, mask=[0, 0, 1, 0, 0, 0])
    assert harness.refusal(masked).reason is Rejection.NON_FINITE


@given(
    twist=numpy_strategies.arrays(
        dtype=st.one_of(
            numpy_strategies.floating_dtypes(),
            numpy_strategies.integer_dtypes(),
            numpy_strategies.complex_number_dtypes(),
            numpy_strategies.boolean_dtypes(),
            numpy_strategies.unicode_string_dtypes(),
        ),
        shape=st.one_of(st.just((6,)), numpy_strategies.array_shapes(min_dims=0, max_dims=2, max_side=7, min_side=0)),
    ),
    ttl_s=st.one_of(st.floats(), st.integers(), st.none(), st.text(max_size=3)),
    frame=st.sampled_from([TwistFrame.BASE, TwistFrame.TCP, "base", None]),
)
@settings(max_examples=300)
def test_any_command_is_refused_or_sent_finite_and_within_the_limits(twist: Any, ttl_s: Any, frame: Any) -> None:
    harness = GateHarness()
    for _ in range(3):
        try:
            sent = harness.send(twist, ttl_s=ttl_s, frame=frame)
        except CommandRejected:
            continue
        assert np.isfinite(sent.command.twist).all()
        assert np.linalg.norm(sent.command.twist[:3]) <= 0.1 * (1 + 1e-6)
        assert np.linalg.norm(sent.command.twist[3:]) <= 0.5 * (1 + 1e-6)


# --- what it returns is its own


def test_neither_the_command_nor_what_was_sent_can_be_written_to(harness: GateHarness) -> None:
    sent = harness.cruise()
    for twist in (sent.command.twist, TwistCommand(FORWARD, TwistFrame.BASE, 0, 0.1).twist):
        with pytest.raises(ValueError, match="read-only"):
            twist *= 1e3
        with pytest.raises(ValueError, match="WRITEABLE"):
            twist.setflags(write=True)


def test_the_array_that_a_command_was_made_of_may_change_without_changing_the_command(harness: GateHarness) -> None:
    mine = np.array([0.01, 0, 0, 0, 0, 0])
    command = TwistCommand(mine, TwistFrame.BASE, harness.clock.now_ns(), 0.1)
    mine[:] = math.nan
    sent = harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, np.eye(4))
    mine[:] = 7.0
    assert np.isfinite(sent.command.twist).all()
    np.testing.assert_array_equal(command.twist, [0.01, 0, 0, 0, 0, 0])


def test_a_read_only_view_of_an_array_that_changes_does_not_change_what_was_sent(harness: GateHarness) -> None:
    mine = np.array([0.01, 0, 0, 0, 0, 0])
    view = mine.view()
    view.setflags(write=False)
    for _ in range(60):
        sent = harness.send(view)
    mine[:] = math.nan
    np.testing.assert_array_equal(sent.command.twist, [0.01, 0, 0, 0, 0, 0])
    after = harness.send(np.array([0.01, 0, 0, 0, 0, 0]))
    np.testing.assert_array_equal(after.command.twist, [0.01, 0, 0, 0, 0, 0])


@pytest.mark.parametrize(
    ("made", "reason"),
    [
        (np.full(6, math.nan), Rejection.NON_FINITE),
        (np.array([math.inf, 0, 0, 0, 0, 0]), Rejection.NON_FINITE),
        (np.array([0, 0, 0, -math.inf, 0, 0]), Rejection.NON_FINITE),
    ],
)
def test_a_twist_changed_by_a_driver_is_checked_again(made: Array, reason: Rejection) -> None:
    harness = GateHarness()
    harness.cruise()

    def follow(twist: Array) -> tuple[Array, tuple[Adjustment, ...]]:
        return made, ()

    harness.clock.advance_s(0.01)
    command = TwistCommand(FORWARD, TwistFrame.BASE, harness.clock.now_ns(), 0.1)
    with pytest.raises(CommandRejected) as caught:
        harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, np.eye(4), follow)
    assert caught.value.reason is reason
    np.testing.assert_array_equal(harness.send().command.twist, FORWARD, "the last good command is what counts")


class Overshooting(DifferentialIk):
    """Kinematics that return a larger twist than the requested one, from the second time on."""

    def __init__(self, scale: float) -> None:
        super().__init__(SerialChain(ChainDescription.shipped("generic_6r")))
        self.scales = [1.0, scale]

    def at(self, q: Array) -> Any:
        local, scales = super().at(q), self.scales

        class Local:
            def limited(self, twist: Array) -> Any:
                return local.limited(twist)[0], scales.pop(0), ()

            def acceleration_scale(self, step: Array, dt_s: float) -> Any:
                return 1.0, ()

        return Local()


@pytest.mark.parametrize(
    ("scale", "reason", "limit"),
    [
        (1e3, Rejection.LIMIT, (0.1, 0.5)),
        # The gate takes one part in a million for rounding.
        (1.0 + 1.5e-6, Rejection.LIMIT, (0.1, 0.5)),
        (1.0 + 0.5e-6, None, None),
        (math.nan, Rejection.NON_FINITE, None),
        (math.inf, Rejection.NON_FINITE, None),
    ],
)
@pytest.mark.parametrize("twist", [FORWARD, np.array([0, 0, 0, 0.5, 0, 0])])
def test_kinematics_that_return_too_much_are_caught_before_it_is_sent(
    twist: Array, scale: float, reason: Rejection | None, limit: Any
) -> None:
    harness = GateHarness(NO_JERK)
    ik = Overshooting(scale)
    harness.cruise(twist)

    def joints() -> Any:
        return ik.at(np.full(6, 0.5))

    def admit() -> Sent[TwistCommand]:
        with np.errstate(invalid="ignore"):
            return harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, np.eye(4), joints=joints)

    command = TwistCommand(twist, TwistFrame.BASE, harness.clock.now_ns(), 0.1)
    if reason is None:
        np.testing.assert_allclose(admit().command.twist, twist, rtol=1e-6)
        return
    with pytest.raises(CommandRejected) as refused:
        admit()
    assert (refused.value.reason, refused.value.limit) == (reason, limit)


@pytest.mark.parametrize("field", ["speed_m_s", "rot_speed_rad_s"])
def test_a_limit_that_is_no_number_lets_nothing_through(field: str) -> None:
    harness = GateHarness(replace(LIMITS, **{field: math.nan}))
    assert harness.refusal().reason is Rejection.LIMIT


# --- from rest


@pytest.mark.parametrize("ttl_s", [0.0005, 0.001, 0.03, 0.3, 0.5])
@pytest.mark.parametrize("rate_hz", [12.5, 100.0, 1000.0])
@pytest.mark.parametrize("limits", [LIMITS, NO_JERK], ids=["jerk", "no jerk"])
def test_from_rest_every_command_obeys_acceleration_whatever_its_time_to_live(
    ttl_s: float, rate_hz: float, limits: TwistLimits
) -> None:
    harness = GateHarness(limits)
    before = np.zeros(6)
    for k in range(5):
        sent = harness.send(ttl_s=ttl_s, after_s=1.0 / rate_hz)
        # After the end of its time the arm is at rest, so the step is limited from rest.
        before = before if ttl_s >= 1.0 / rate_hz else np.zeros(6)
        step_s = FIRST_STEP_S if k == 0 or ttl_s < 1.0 / rate_hz else 1.0 / rate_hz
        assert np.linalg.norm(sent.command.twist - before) <= 0.5 * step_s * (1 + 1e-9)
        assert sent.limited or k > 0
        before = sent.command.twist


@pytest.mark.parametrize("ttl_s", [5e-324, 1e-310, 1e-200, 1e-12])
def test_a_time_to_live_too_short_to_divide_by_is_limited_as_a_microsecond(harness: GateHarness, ttl_s: float) -> None:
    for _ in range(3):
        sent = harness.send(ttl_s=ttl_s)
        assert 0.0 < np.linalg.norm(sent.command.twist) <= 0.5e-6
    first = GateHarness(NO_JERK).send(ttl_s=ttl_s)
    assert np.linalg.norm(first.command.twist) == pytest.approx(0.5e-6)


def test_a_reset_makes_the_next_command_the_first(harness: GateHarness) -> None:
    harness.cruise()
    harness.gate.reset()
    assert np.linalg.norm(harness.send(after_s=0.0).command.twist) <= 0.5 * FIRST_STEP_S


def test_the_scale_is_the_smaller_of_both_parts() -> None:
    """Also where the linear part requires a smaller scale and comes first."""
    harness = GateHarness(NO_JERK)
    requested = np.array([0.4, 0, 0, 1.0, 0, 0])
    sent = harness.cruise(requested)
    np.testing.assert_allclose(sent.command.twist, 0.25 * requested, rtol=1e-9)
    assert {a.limit for a in sent.adjustments} == {"tcp linear speed", "tcp angular speed"}
    other = np.array([0.2, 0, 0, 2.0, 0, 0])
    np.testing.assert_allclose(harness.cruise(other).command.twist, 0.25 * other, rtol=1e-9)


def test_a_twist_along_tool_axes_is_turned_whole_and_a_twist_along_base_axes_not_at_all(harness: GateHarness) -> None:
    T = np.array([[0, -1, 0, 0.4], [1, 0, 0, 0], [0, 0, 1, 0.3], [0, 0, 0, 1.0]])
    requested = np.array([0.05, 0, 0.01, 0.2, 0, 0.1])
    for frame, expected in ((TwistFrame.TCP, [0, 0.05, 0.01, 0, 0.2, 0.1]), (TwistFrame.BASE, requested)):
        for _ in range(60):
            harness.clock.advance_s(0.01)
            command = TwistCommand(requested, frame, harness.clock.now_ns(), 0.1, t_cause_ns=5)
            sent = harness.gate.admit(command, harness.lease, Lifecycle.ACTIVE, T)
        np.testing.assert_allclose(sent.command.twist, expected, atol=1e-15)
        assert sent.command.frame is TwistFrame.BASE
        assert (sent.command.t_ns, sent.command.t_cause_ns, sent.t_ns) == (command.t_ns, 5, harness.clock.now_ns())


def test_a_checked_array_is_a_copy_unless_nothing_can_change_it() -> None:
    mine = np.array([0.01, 0, 0, 0, 0, 0])
    checked = finite_array("arm", "twist", mine, (6,))
    mine[:] = math.nan
    assert np.isfinite(checked).all()
    immutable = read_only(np.zeros(6))
    assert finite_array("arm", "twist", immutable, (6,)) is immutable


def test_the_first_command_from_rest_accelerates_for_a_millisecond_at_most() -> None:
    """The shortest control cycle: 0.5 m/s2 for 1 ms."""
    harness = GateHarness(NO_JERK)
    assert np.linalg.norm(harness.send(ttl_s=0.5).command.twist) == pytest.approx(0.5e-3)
    at_zero = GateHarness(NO_JERK, start_ns=0)
    assert np.linalg.norm(at_zero.send(ttl_s=0.5, after_s=0.0).command.twist) == pytest.approx(0.5e-3)


class _Marked(TwistCommand):
    """A command of another package's own class."""


@pytest.mark.parametrize(
    ("kind", "t_ns", "ttl_s"),
    [
        (TwistCommand, np.int64(5), 0.1),
        (TwistCommand, 5, np.float32(0.125)),
        (_Marked, 5, 0.1),
    ],
)
def test_what_is_checked_consists_of_plain_numbers_and_is_no_class_of_others(
    kind: type[TwistCommand], t_ns: int, ttl_s: float
) -> None:
    command = kind(read_only(np.zeros(6)), TwistFrame.BASE, t_ns, ttl_s)
    checked = checked_twist_command("arm", command)
    assert type(checked) is TwistCommand
    assert type(checked.t_ns) is int
    assert type(checked.ttl_s) is float
    assert (checked.t_ns, checked.ttl_s) == (int(t_ns), float(ttl_s))
