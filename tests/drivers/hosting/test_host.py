"""A device host, cycle by cycle on virtual time: execution of commands and stops. No process is started."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, LifecycleError, Rejection, TouchcellError
from touchcell.drivers.core.gate import FIRST_STEP_S
from touchcell.drivers.hosting.host import Host
from touchcell.drivers.hosting.layouts import (
    ANSWER,
    ARM,
    COMMAND,
    HOST,
    WATCH,
    Cause,
    Reason,
    RecordReader,
    RecordWriter,
    close_fd,
    create_block,
    read_cause,
    write_cause,
)
from touchcell.drivers.hosting.wire import decode_note
from touchcell.simulation.devices.arm import SimArm

PERIOD_S = 0.02
STEP_NS = 2_000_000


class HostHarness:
    """A host with two simulated arms, and all blocks in the hands of the test."""

    def __init__(self, categories: tuple[int, int] = (2, 2)) -> None:
        self.fds: list[int] = []
        self.clock = VirtualClock(1_000_000_000)
        arms = {
            name: {
                kind: self.block(dtype) for kind, dtype in (("command", COMMAND), ("answer", ANSWER), ("state", ARM))
            }
            for name in ("left", "right")
        }
        wake, answered = os.eventfd(0, os.EFD_NONBLOCK), os.eventfd(0, os.EFD_NONBLOCK)
        watch, beat = self.block(WATCH), self.block(HOST)
        self.fds += [wake, answered]
        self.ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.theirs = theirs
        config = {"start_pose_mm_deg": (0, 0, 200, 180, 0, 0)}
        spec = {
            "period_s": PERIOD_S,
            "rate_hz": 500.0,
            "seed": 0,
            "scene": None,
            "devices": [
                {"name": name, "driver": "sim_arm", "config": config, "category": category, "policy": "hold"}
                for name, category in zip(arms, categories, strict=True)
            ],
            "fds": {"wake": wake, "answered": answered, "watch": watch, "host": beat, "devices": arms},
        }
        self.host = Host(spec, theirs, self.clock)
        self.watch = RecordWriter(watch, WATCH)
        self.beat = RecordReader(beat, HOST)
        self.commands = {name: RecordWriter(fds["command"], COMMAND) for name, fds in arms.items()}
        self.answers = {name: RecordReader(fds["answer"], ANSWER) for name, fds in arms.items()}
        self.states = {name: RecordReader(fds["state"], ARM) for name, fds in arms.items()}
        self.leases: dict[str, int] = {}
        self.guarding = False
        self.beating = True
        self.number = 0
        for name in arms:
            for call in ("connect", "configure", "activate"):
                self.call(call, name)
            self.leases[name] = self.call("acquire", name, owner="test")["epoch"]

    def block(self, dtype: Any) -> int:
        self.fds.append(create_block("test", dtype))
        return self.fds[-1]

    def call(self, call: str, device: str = "", **arguments: Any) -> dict[str, Any]:
        return self.host._call({"call": call, "device": device, **arguments})

    def arm(self, name: str) -> SimArm:
        arm = self.host.devices[name]
        assert isinstance(arm, SimArm)
        return arm

    def step(self, cycles: int = 1) -> None:
        for _ in range(cycles):
            self.clock.advance_s(STEP_NS * 1e-9)
            if self.beating:
                self.write_watchdog_record()
            self.host.cycle()

    def write_watchdog_record(self, cause: Cause | None = None) -> None:
        value = self.watch.value
        value["count"] += 1
        value["t_ns"], value["guarding"] = self.clock.now_ns(), self.guarding
        if cause is not None:
            value["stop"] = True
            write_cause(value, cause)
        self.watch.publish()

    def send(self, name: str, speed_m_s: float = 0.02, ttl_s: float = 0.06) -> TouchcellError | None:
        """Write a twist, let the host look, and return what it refused it with."""
        self.number += 1
        value = self.commands[name].value
        value["number"], value["lease"], value["t_ns"] = self.number, self.leases[name], self.clock.now_ns()
        value["twist"], value["ttl_s"] = [speed_m_s, 0, 0, 0, 0, 0], ttl_s
        self.commands[name].publish()
        self.host.cycle()
        _, answer, note = self.answers[name].read_all()
        assert answer["number"] == self.number
        return decode_note(note, name) if answer["refused"] else None

    def move(self, cycles: int = 30) -> None:
        """Both arms at 20 mm/s, guarded."""
        self.guarding = True
        for _ in range(cycles):
            self.step()
            assert [self.send(name) for name in self.states] == [None, None]
        assert all(np.isclose(state.read()["twist"][0], 0.02) for state in self.states.values())

    def close(self) -> None:
        for block in (self.watch, self.beat, *self.commands.values(), *self.answers.values(), *self.states.values()):
            block.close()
        self.ours.close()
        self.theirs.close()
        for fd in self.fds:
            close_fd(fd)


@pytest.fixture
def harness() -> Iterator[HostHarness]:
    harness = HostHarness()
    yield harness
    harness.close()


def test_nothing_moves_without_guarding(harness: HostHarness) -> None:
    harness.step()
    refused = harness.send("left")
    assert isinstance(refused, CommandRejected)
    assert refused.reason is Rejection.MODE
    harness.step(20)
    assert harness.states["left"].read()["at_rest"]
    assert harness.states["left"].read()["obeyed"] == 0


def test_lease_freshness_and_limits_are_checked_in_the_host(harness: HostHarness) -> None:
    harness.guarding = True
    harness.step()
    harness.leases["left"] += 1
    refused = harness.send("left")
    assert isinstance(refused, CommandRejected)
    assert refused.reason is Rejection.LEASE
    harness.leases["left"] -= 1
    refused = harness.send("left", ttl_s=5.0)
    assert isinstance(refused, CommandRejected)
    assert refused.reason is Rejection.LIMIT
    refused = harness.send("left", speed_m_s=float("nan"))
    assert isinstance(refused, CommandRejected)
    assert refused.reason is Rejection.NON_FINITE
    harness.step()
    assert harness.send("left", speed_m_s=9.0) is None
    sent = harness.answers["left"].read()["twist"]
    assert 0.0 < sent[0] <= 0.5 * FIRST_STEP_S, "the gate limits acceleration"


def test_a_command_expires_in_the_host_without_a_newer_one(harness: HostHarness) -> None:
    harness.move()
    harness.step(60)
    record = harness.states["left"].read()
    assert record["at_rest"]
    assert not harness.beat.read()["latched"]


def test_the_stop_flag_stops_both_arms_in_that_cycle_and_latches(harness: HostHarness) -> None:
    harness.move()
    harness.write_watchdog_record(Cause(Reason.TASK_SILENT, harness.clock.now_ns(), 0.06, 0.05))
    harness.host.cycle()
    stopped_ns = harness.clock.now_ns()
    for _ in range(60):
        refused = harness.send("left")
        assert isinstance(refused, CommandRejected)
        assert refused.reason is Rejection.MODE
        harness.step()
    assert read_cause(harness.beat.read()).reason is Reason.TASK_SILENT
    for state in harness.states.values():
        record = state.read()
        assert record["at_rest"]
        assert record["stop_ns"] == stopped_ns
        assert record["executed_ns"] <= stopped_ns
        assert 0.038 <= (record["rest_ns"] - stopped_ns) * 1e-9 <= 0.046, "20 mm/s at 0.5 m/s2"
        assert np.isclose(record["stop_speed_m_s"], 0.02)
        assert np.isclose(record["stop_way_m"], 0.0004, atol=1e-4)


@given(silent_after=st.integers(1, 20))
@settings(max_examples=20)
def test_a_silent_watchdog_is_found_within_its_time(silent_after: int) -> None:
    harness = HostHarness()
    try:
        harness.move(30 + silent_after)
        last_ns = int(harness.watch.value["t_ns"])
        harness.beating = False
        refused = None
        while refused is None:
            harness.step()
            refused = harness.send("right")
        cause = read_cause(harness.beat.read())
        assert cause.reason is Reason.WATCHDOG_SILENT
        assert 0.05 < (cause.t_ns - last_ns) * 1e-9 <= 0.05 + STEP_NS * 1e-9
        # Its beats come back, and nothing changes.
        harness.beating = True
        harness.step(60)
        assert harness.send("right") is not None
        assert all(state.read()["at_rest"] for state in harness.states.values())
    finally:
        harness.close()


def test_end_of_guarding_stops_moving_arms(harness: HostHarness) -> None:
    harness.move()
    harness.guarding = False
    harness.step(30)
    assert all(state.read()["at_rest"] for state in harness.states.values())
    assert not harness.beat.read()["latched"]


def test_an_arm_that_runs_on_is_stopped_by_stronger_means(harness: HostHarness) -> None:
    harness.move()
    arm = harness.arm("left")
    arm.faults = replace(arm.faults, ignores_expiry=True)
    harness.write_watchdog_record(Cause(Reason.TASK_SILENT, harness.clock.now_ns()))
    harness.step(400)
    record = harness.states["left"].read()
    assert record["escalated"]
    assert record["at_rest"]
    assert arm.state is Lifecycle.READY
    assert not harness.states["right"].read()["escalated"]


def test_each_arm_stops_by_its_own_category() -> None:
    harness = HostHarness((1, 2))
    harness.move()
    harness.write_watchdog_record(Cause(Reason.HOST_SILENT, harness.clock.now_ns(), host=1))
    harness.step(60)
    assert harness.arm("left").state is Lifecycle.READY
    assert harness.arm("right").state is Lifecycle.ACTIVE
    harness.close()


def test_the_latch_is_cleared_only_at_rest_without_lease_and_stop_flag(harness: HostHarness) -> None:
    harness.move()
    harness.write_watchdog_record(Cause(Reason.TASK_SILENT, harness.clock.now_ns()))
    harness.host.cycle()
    harness.guarding = False

    def refused() -> bool:
        try:
            harness.call("clear")
        except LifecycleError:
            return True
        return False

    assert refused(), "still moving"
    harness.step(60)
    assert refused(), "the stop flag is set"
    harness.watch.value["stop"] = False
    harness.step()
    assert refused(), "the lease is held"
    for name, epoch in harness.leases.items():
        harness.call("release", name, epoch=epoch)
    harness.guarding = True
    harness.step()
    assert refused(), "guarded"
    harness.guarding = False
    harness.step()
    assert not refused()
    harness.step(60)
    assert not harness.beat.read()["latched"]
    assert all(state.read()["at_rest"] for state in harness.states.values()), "clearing moves nothing"


def test_a_stop_drops_the_twist_that_was_written_before_it(harness: HostHarness) -> None:
    harness.move()
    harness.step()
    obeyed = int(harness.states["left"].read()["obeyed"])
    value = harness.commands["left"].value
    value["number"] += 1
    value["stop"], value["category"] = value["number"] + 1, 2
    harness.commands["left"].publish()
    harness.step(60)
    record = harness.states["left"].read()
    assert record["obeyed"] == obeyed
    assert record["at_rest"]


def test_an_error_raised_by_a_driver_is_published_with_the_state(harness: HostHarness) -> None:
    harness.move()
    harness.arm("left").disconnect()
    harness.step()
    record = harness.states["left"].read()
    assert record["lifecycle"] == 0
    assert not harness.states["right"].read()["failed"]
