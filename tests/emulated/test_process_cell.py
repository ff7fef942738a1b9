"""Cells whose devices live in processes of their own, with real processes and real faults."""

from __future__ import annotations

import contextlib
import gc
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.fault_injection.process_faults import FAULTS, ProcessCase, ProcessFault, TooBusy, run_fault
from tests.fault_injection.two_arms import EMULATORS, SPEED_M_S, pushing_plan, two_arm_plan
from touchcell.cell.analysis.trip_report import explain
from touchcell.cell.cli.main import main
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.cell.recording.message_types import Encoded
from touchcell.cell.runtime.cell import Cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.operator_channel import OperatorChannel, OperatorRequest
from touchcell.cell.runtime.process_watchdog import ProcessWatchdog, hosted_groups
from touchcell.cell.runtime.run_result import Outcome
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.cell.runtime.watchdog import NOTES
from touchcell.control.latch import LatchState
from touchcell.drivers.core.clock import MonotonicClock
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.device import Lifecycle
from touchcell.drivers.core.errors import CommandRejected, DeviceFault, LifecycleError, Rejection, StaleData
from touchcell.drivers.core.lease import Lease
from touchcell.drivers.hosting import self_test as selftest
from touchcell.drivers.hosting.chain import Chain
from touchcell.drivers.hosting.groups import Group, HostedDevice
from touchcell.drivers.hosting.proxies import RemoteJointArm
from touchcell.drivers.hosting.self_test import SelfTestFailed, self_test
from touchcell.drivers.ur.rig import rig
from touchcell.paths import CONFIGS
from touchcell.simulation.scene import Scene

RATE_HZ = 5.0
"""Long enough that a process on a busy machine is not considered dead."""

TRIES = 2

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


def children() -> list[str]:
    return Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()


def shared() -> list[str]:
    """Descriptors of the kind that the chain opens."""
    links = []
    for fd in os.listdir("/proc/self/fd"):
        with contextlib.suppress(OSError):
            links.append(os.readlink(f"/proc/self/fd/{fd}"))
    return sorted(link for link in links if link.startswith(("/memfd:touchcell", "socket:", "anon_inode:[eventfd]")))


@pytest.fixture(autouse=True)
def nothing_is_left_behind() -> Iterator[None]:
    # What tests before have left to the collector may be collected at any moment.
    gc.collect()
    blocks, before = shared(), children()
    yield
    assert not list(Path("/dev/shm").glob("*touchcell*")), "the memory has no names"
    assert shared() == blocks
    assert children() == before


def separate_cell(tmp_path: Path, **changes: Any) -> Path:
    data = yaml.safe_load(SHIPPED.read_text()) | {"time": "real", "processes": "separate", "rate_hz": RATE_HZ} | changes
    data["arms"]["arm"]["limits"]["tcp_speed_m_s"] = 0.03
    data["interlocks"]["tcp_speed"]["limit_m_s"] = 0.085
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def twist(
    cell: Cell, speed_m_s: float = 0.01, *, ttl_s: float = 0.5, frame: TwistFrame = TwistFrame.BASE
) -> TwistCommand:
    return TwistCommand(np.array([speed_m_s, 0, 0, 0, 0, 0]), frame, cell.clock.now_ns(), ttl_s, t_cause_ns=5)


def test_a_remote_arm_is_as_an_arm_is(tmp_path: Path) -> None:
    local = compose(two_arm_plan(tmp_path, RATE_HZ, processes="one")).arms["left"]
    with compose(two_arm_plan(tmp_path, RATE_HZ, categories={"right": 1})) as cell:
        watch = cell.watchdog
        assert isinstance(watch, ProcessWatchdog)
        assert [proof.link for proof in watch.proofs] == ["the task's heartbeat", "the watchdog"]
        for proof in watch.proofs:
            # The watchdog's last beat may have come a quarter of a period before it was stopped.
            assert watch.chain.silence_s - 0.25 / RATE_HZ < proof.time_s <= proof.declared_s
        left, right = cell.arms["left"], cell.arms["right"]
        assert left.limits == local.limits
        assert left.stop_categories == local.stop_categories
        assert left.state is Lifecycle.ACTIVE
        lease = left.acquire("test")
        assert left.owner == "test"
        with pytest.raises(CommandRejected) as caught:
            left.send_twist(twist(cell), lease)
        assert (caught.value.reason, caught.value.device) == (Rejection.MODE, "left"), "not guarded yet"
        with pytest.raises(CommandRejected) as caught:
            left.acquire("another")
        assert (caught.value.reason, caught.value.value) == (Rejection.LEASE, "another")
        watch.begin()
        watch.beat()
        sent = left.send_twist(twist(cell, 5.0), lease)
        assert 0.0 < sent.command.twist[0] <= 0.1
        assert not sent.command.twist[1:].any()
        assert sent.command.t_cause_ns == 5
        assert [a.limit for a in sent.adjustments][:2] == ["tcp linear speed", "tcp linear acceleration"]
        assert sent.adjustments[0].requested == 5.0
        for bad, reason in (
            (twist(cell, np.nan), Rejection.NON_FINITE),
            (twist(cell, ttl_s=0.0), Rejection.LIMIT),
            (TwistCommand(np.zeros(5), TwistFrame.BASE, 0, 0.1), Rejection.SHAPE),
            (TwistCommand(np.zeros(6), TwistFrame.BASE, 0, 0.1), Rejection.EXPIRED),
        ):
            watch.beat()
            with pytest.raises(CommandRejected) as caught:
                left.send_twist(bad, lease)
            assert caught.value.reason is reason
        with pytest.raises(CommandRejected) as caught:
            left.send_twist(twist(cell), Lease("left", "test", lease.epoch))
        assert caught.value.reason is Rejection.LEASE, "a copy of a lease is worth nothing"
        with pytest.raises(StaleData):
            left.tcp(max_age_s=0.0)
        with pytest.raises(LifecycleError):
            left.stop(0)
        watch.beat()
        assert not left.at_rest()
        left.stop()
        watch.end()
        deadline_ns = cell.clock.now_ns() + 2_000_000_000
        while not left.at_rest():
            assert cell.clock.now_ns() < deadline_ns
            cell.clock.sleep_until_ns(cell.clock.now_ns() + 1_000_000)
        assert left.tcp().value.T_base_tcp[0, 3] > -0.3
        assert left.health()["owner"] == "test"
        left.release(lease)
        assert left.health()["owner"] == ""
        assert right.owner is None
    assert left.state is Lifecycle.DISCONNECTED
    with pytest.raises(LifecycleError):
        left.tcp()


def test_the_chain_stops_an_arm_on_the_wire(tmp_path: Path) -> None:
    """An emulated UR: its host publishes its joints, and the self-test stops its controller."""
    wired = rig(tmp_path, 4_517_000 + os.getpid() % 1000)
    assert wired.start is not None
    assert wired.config is not None
    emulator = wired.start()
    group = Group("arm", (HostedDevice("arm", wired.spec, wired.config, 2, "hold"),), "an arm by itself")
    try:
        with Chain([group], RATE_HZ, 0, MonotonicClock()) as chain:
            arm = chain.arms["arm"]
            assert isinstance(arm, RemoteJointArm)
            arm.connect()
            arm.configure()
            arm.activate()
            ik, q, state = arm.kinematics(), arm.joints().value.q, arm.tcp().value
            assert ik is not None
            np.testing.assert_allclose(ik.chain.forward(q), state.T_base_tcp, atol=1e-4)
            assert len(self_test(chain)) == 2
            arm.deactivate()
            arm.disconnect()
    finally:
        emulator.stop()


def test_a_task_runs_on_pictures_from_another_process(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = separate_cell(tmp_path)
    assert main(["check", str(path)]) == 0
    told = capsys.readouterr().out
    assert "host 'scene': arm, sensor at 500 Hz" in told
    assert "watchdog: stops all arms after 500 ms of silence" in told
    cell, stop = compose(plan_cell(path)), StopRequest()
    with cell:
        camera = cell.cameras["sensor"]
        frame = camera.latest()  # type: ignore[attr-defined]
        assert frame.value.image.shape == (480, 640)
        assert camera.next(frame.seq, 1.0).seq > frame.seq  # type: ignore[attr-defined]
        loop = RunLoop(cell, None, stop=stop)
        loop.begin()
        for _ in range(20):
            loop.step()
        assert cell.sensors["sensor"].source.frame is not None  # type: ignore[attr-defined]
        stop.ask_at_once()
        loop.step()
        result = loop.end()
        assert result.outcome in (Outcome.STOPPED, Outcome.TRIPPED), result.reason
        assert result.stops["arm"].time_s is not None


def test_activation_is_refused_when_the_chain_does_not_stop_in_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(selftest, "MARGIN_S", -0.2)
    with pytest.raises(SelfTestFailed) as caught, compose(two_arm_plan(tmp_path, RATE_HZ)):
        pytest.fail("it was activated")
    assert caught.value.link == "the task's heartbeat"
    assert caught.value.measured_s is None
    assert caught.value.declared_s < 2.5 / RATE_HZ


def inject(tmp_path: Path, fault: ProcessFault) -> ProcessCase:
    """The fault in a cell that ran until then; where this machine starves it, the watchdog has done its work before."""
    for k in range(TRIES - 1):
        with contextlib.suppress(TooBusy):
            return run_fault(tmp_path / str(k), fault, RATE_HZ)
    return run_fault(tmp_path / "last", fault, RATE_HZ)


@pytest.mark.parametrize(
    ("name", "reported_as"),
    [
        ("task killed", "TASK_GONE"),
        ("task stopped", "TASK_SILENT"),
        ("watchdog killed", None),
    ],
)
def test_both_arms_stop_in_time_whichever_process_dies(tmp_path: Path, name: str, reported_as: str | None) -> None:
    """The others of ``FAULTS`` are in ``touchcell bench safety -- --processes``."""
    fault = next(fault for fault in FAULTS if fault.name == name)
    case = inject(tmp_path, fault)
    assert list(case.problems) == []
    assert len(case.arms) == 2
    assert case.notes.get("reason") == reported_as
    for arm in case.notes.get("arms", {}).values():
        assert arm["speed_m_s"] == pytest.approx(SPEED_M_S)
        assert arm["time_s"] == pytest.approx(SPEED_M_S / 0.5, abs=0.02)
        assert arm["last_executed_ns"] <= arm["stopped_ns"]
    if fault.name != "task killed":
        assert case.outcome["outcome"] == "tripped"
        assert case.outcome["causes"][0][0] == "watchdog"


class ResetProcedure:
    """A run with two swaying arms that waits for its operator after a trip; the operator is the test."""

    def __init__(self, cell: Cell) -> None:
        watch = cell.watchdog
        assert isinstance(watch, ProcessWatchdog)
        self.cell, self.chain, self.desk, self.stop = cell, watch.chain, OperatorChannel(), StopRequest()
        self.loop = RunLoop(cell, None, stop=self.stop, channel=self.desk)
        self.loop.begin()

    def until(self, done: Callable[[], bool]) -> None:
        deadline_s = time.monotonic() + 20.0
        while not done():
            assert time.monotonic() < deadline_s
            assert self.loop.step()

    def ask(self, ask: OperatorRequest) -> str:
        self.desk.last_reply = ""
        self.desk.ask(ask, "ada")
        assert self.loop.step()
        return self.desk.last_reply

    def positions(self) -> Any:
        return [arm.tcp().value.T_base_tcp[:3, 3] for arm in self.cell.arms.values()]

    def moves(self) -> bool:
        return not any(arm.at_rest() for arm in self.cell.arms.values())

    def is_latched(self) -> bool:
        return all(link.latched() is not None for link in self.chain.hosts)


def test_a_stop_by_the_chain_is_reset_after_its_cause_and_the_run_continues(tmp_path: Path) -> None:
    with compose(two_arm_plan(tmp_path, RATE_HZ, categories={"right": 1}, on_trip="wait_for_reset")) as cell:
        run = ResetProcedure(cell)
        run.until(run.moves)
        run.chain.hold_watchdog(True)
        run.until(lambda: cell.task.finished)
        assert cell.supervisor.latch.first_cause is not None
        assert cell.supervisor.latch.first_cause.interlock == "watchdog"
        assert run.is_latched()
        assert run.ask(OperatorRequest.RESET).startswith("refused"), "the watchdog still hangs"
        assert run.ask(OperatorRequest.RESUME) == "refused: reset first"
        assert run.is_latched()
        run.chain.hold_watchdog(False)
        run.until(lambda: cell.supervisor.latch.state is LatchState.CAUSE_GONE)
        stood = run.positions()
        run.until(lambda: run.ask(OperatorRequest.RESET).startswith("reset; nothing moves"))
        assert not any(link.latched() for link in run.chain.hosts)
        for _ in range(5):
            assert run.loop.step()
        np.testing.assert_array_equal(run.positions(), stood)
        lease = cell.arms["left"].acquire("somebody")
        with pytest.raises(CommandRejected, match="not guarded by a watchdog"):
            cell.arms["left"].send_twist(twist(cell), lease)
        cell.arms["left"].release(lease)
        assert "starts again" in run.ask(OperatorRequest.RESUME)
        run.until(run.moves)
        run.stop.ask()
        while run.loop.step():
            continue
        result = run.loop.end()
    assert (result.outcome, result.reason) == (Outcome.DONE, "")
    assert [(reset.operator, reset.causes[0].interlock) for reset in result.resets] == [("ada", "watchdog")]


def test_a_reset_is_refused_for_good_when_a_host_has_died(tmp_path: Path) -> None:
    with compose(two_arm_plan(tmp_path, RATE_HZ, on_trip="wait_for_reset")) as cell:
        run = ResetProcedure(cell)
        run.until(run.moves)
        os.kill(run.chain.hosts[0].pid, signal.SIGKILL)
        run.until(lambda: cell.task.finished)
        for _ in range(5):
            assert run.loop.step()
        assert run.ask(OperatorRequest.RESET).startswith("refused")
        assert run.ask(OperatorRequest.RESUME) == "refused: reset first"
        assert cell.arms["right"].at_rest()
        run.stop.ask()
        assert not run.loop.step()
        result = run.loop.end()
    assert result.outcome is Outcome.TRIPPED
    assert result.resets == ()


def test_a_dead_host_is_a_fault_of_its_devices(tmp_path: Path) -> None:
    cell = compose(two_arm_plan(tmp_path, RATE_HZ))
    with cell:
        watch = cell.watchdog
        assert isinstance(watch, ProcessWatchdog)
        host = watch.chain.hosts[0]
        host.process.kill()
        host.process.wait()
        with pytest.raises(DeviceFault, match="SIGKILL") as caught:
            cell.arms["left"].tcp()
        assert caught.value.device == "left"
        assert cell.arms["left"].state is Lifecycle.FAULTED
        assert cell.arms["right"].tcp().age_s(cell.clock.now_ns()) < 1.0


def test_a_hanging_host_delays_others_only_briefly(tmp_path: Path) -> None:
    started_s = time.monotonic()
    with compose(two_arm_plan(tmp_path, RATE_HZ)) as cell:
        watch = cell.watchdog
        assert isinstance(watch, ProcessWatchdog)
        os.kill(watch.chain.hosts[0].pid, signal.SIGSTOP)
        while not watch.chain.hosts[0].hangs():
            time.sleep(0.05)
        with pytest.raises(DeviceFault, match="hangs"):
            cell.arms["left"].acquire("test")
        assert cell.arms["left"].state is Lifecycle.FAULTED
    # A call that waited would have taken twenty seconds.
    assert time.monotonic() - started_s < 18.0


def test_a_cell_reports_capabilities_unavailable_across_processes(tmp_path: Path) -> None:
    with pytest.raises(InvalidCell) as caught:
        plan_cell(separate_cell(tmp_path, time="simulated"))
    assert [problem.key for problem in caught.value.problems] == ["processes"]


class Topics:
    """A flight recorder that stores the events it receives."""

    def __init__(self) -> None:
        self.told: set[str] = set()

    def add(self, messages: Sequence[tuple[str, int, Encoded]]) -> None:
        self.told.update(topic for topic, _, _ in messages)


def test_the_ground_truth_of_a_scene_in_a_host_is_published_and_recorded(tmp_path: Path) -> None:
    """A task runs on it, and objects are on record, though their scene is in another process."""
    data = yaml.safe_load((SHIPPED.parent / "single_push_sim.yaml").read_text())
    data |= {"time": "real", "processes": "separate", "rate_hz": RATE_HZ}
    data["arms"]["arm"]["limits"]["tcp_speed_m_s"] = 0.03
    data["interlocks"]["tcp_speed"]["limit_m_s"] = 0.085
    data["task"] |= {"push_speed_mm_s": 20, "sidestep_speed_mm_s": 20}
    put_on_true_contact(data)
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    box = Topics()
    with compose(plan_cell(path)) as cell:
        assert cell.scene is not None
        assert not isinstance(cell.scene, Scene)
        T_world_prism = cell.scene.objects().value["prism"]
        np.testing.assert_allclose(T_world_prism[:2, 3], [0.0, 0.003], atol=1e-6)
        contact = cell.scene.contact("sensor")
        assert not contact.value.in_contact
        # The tip is 5 mm in front of the prism.
        assert contact.value.depth_m == pytest.approx(-0.005, abs=1e-4)
        stop = StopRequest()
        loop = RunLoop(cell, None, box=box, stop=stop)
        loop.begin()
        for _ in range(12):
            loop.step()
        stop.ask_at_once()
        loop.step()
        loop.end()
    assert {"/objects/prism", "/sensors/sensor/truth", "/sensors/sensor/contact"} <= box.told


def test_a_scene_without_a_simulated_arm_stays_in_the_tasks_process(tmp_path: Path) -> None:
    """So that real arms have hosts of their own, and one may die while another continues."""
    (tmp_path / EMULATORS).write_text(json.dumps({"leader": "127.99.0.2", "follower": "127.99.0.3"}))
    plan = pushing_plan(tmp_path, 12.5)
    assert {group.name: group.scene for group in hosted_groups(plan)} == {"leader": None, "follower": None}
    assert isinstance(compose(plan).scene, Scene)


def test_arms_without_a_scene_have_separate_hosts(tmp_path: Path) -> None:
    groups = hosted_groups(two_arm_plan(tmp_path, RATE_HZ))
    assert [group.name for group in groups] == ["left", "right"]
    assert [group.rate_hz(100.0) for group in groups] == [500.0, 500.0]
    assert groups[0].rate_hz(1000.0) == 2000.0


def test_a_cell_in_one_process_starts_no_others(tmp_path: Path) -> None:
    """And does not even import what it would need."""
    script = (
        "import sys, touchcell.cell.runtime.compose, touchcell.cell.cli.run\n"
        "print([m for m in sys.modules if m.startswith('touchcell.drivers.hosting')])"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


def test_why_reports_the_watchdogs_record_of_a_run_whose_process_died(tmp_path: Path) -> None:
    stop = {"speed_m_s": 0.03, "time_s": 0.058, "distance_m": 0.001, "escalated": False}
    note = {"words": "the task's process has ended", "value_s": 0.0, "limit_s": 0.0, "arms": {"left": stop}}
    (tmp_path / NOTES).write_text(json.dumps(note))
    assert explain(tmp_path).splitlines()[2:] == [
        "  the task's process has ended",
        "  left: commanded to stop at 30.0 mm/s; at rest after 0.058 s and 1.00 mm",
    ]
