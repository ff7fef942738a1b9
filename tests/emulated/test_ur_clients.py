"""The emulated controller, judged by unmodified ur-rtde."""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from touchcell.drivers.ur.rig import host_of
from touchcell.testing.emulation.process import EmulatorProcess

rtde_control = pytest.importorskip("rtde_control", reason="pip install touchcell[ur]")
rtde_receive = pytest.importorskip("rtde_receive")
dashboard_client = pytest.importorskip("dashboard_client")

ADDRESSES = itertools.count(5_000_000 + os.getpid() % 40_000 * 100)
DEADLINE_S = 5.0


@pytest.fixture
def host() -> str:
    """A loopback address that no other test uses."""
    return host_of(next(ADDRESSES))


@pytest.fixture
def emulator(host: str) -> Iterator[EmulatorProcess]:
    """A fresh emulated controller."""
    with EmulatorProcess("ur", "--host", host, "--unlock-after", "0.1") as process:
        yield process


def wait_until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"no {what} within {DEADLINE_S} s"
        time.sleep(0.002)


def test_receive_control_and_dashboard(emulator: EmulatorProcess, host: str) -> None:
    receive = rtde_receive.RTDEReceiveInterface(host)
    control = rtde_control.RTDEControlInterface(host)
    truth = emulator.state()
    assert receive.getActualTCPPose() == pytest.approx(truth["pose"])
    assert receive.getActualQ() == pytest.approx(truth["q"])
    assert (receive.getRobotMode(), receive.getSafetyMode(), receive.getRuntimeState()) == (7, 1, 2)
    assert control.isProgramRunning()

    assert control.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])
    assert control.getTCPOffset() == pytest.approx([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])

    twist = [0.05, 0.0, -0.02, 0.0, 0.0, 0.1]
    wait_until(
        lambda: control.speedL(twist, 1.0, 0.002) and np.allclose(receive.getActualTCPSpeed(), twist, atol=1e-3),
        "speed",
    )
    assert control.speedStop(5.0)
    assert not emulator.state()["moving"]

    goal = [0.1, -1.5, -1.6, -1.5, 1.5, 0.1]
    assert control.moveJ(goal, 1.0, 4.0)
    assert emulator.state()["q"] == pytest.approx(goal)
    pose = emulator.state()["pose"]
    pose[2] -= 0.02
    assert control.moveL(pose, 0.25, 2.0)
    np.testing.assert_allclose(emulator.state()["pose"], pose, atol=1e-6)
    pose[0] += 0.01
    wait_until(
        lambda: (
            control.servoL(pose, 0.5, 0.5, 0.002, 0.03, 300) and np.allclose(emulator.state()["pose"], pose, atol=1e-4)
        ),
        "servo",
    )
    assert control.servoStop()
    assert control.moveJ([q + 0.5 for q in goal], 1.0, 2.0, True)
    wait_until(lambda: control.getAsyncOperationProgressEx().isAsyncOperationRunning(), "start of the move")
    control.stopJ(5.0, True)
    wait_until(lambda: not emulator.state()["moving"], "rest")

    dashboard = dashboard_client.DashboardClient(host)
    dashboard.connect()
    assert dashboard.polyscopeVersion() == "5.11.1.108249"
    assert dashboard.isInRemoteControl()
    assert dashboard.robotmode() == "Robotmode: RUNNING"
    assert dashboard.safetystatus() == "Safetystatus: NORMAL"
    assert dashboard.running()
    emulator.fault("protective_stop")
    wait_until(receive.isProtectiveStopped, "protective stop")
    assert not control.speedL(twist, 1.0, 0.002)
    wait_until(lambda: _unlocks(dashboard), "release of the protective stop")
    emulator.fault("emergency_stop")
    wait_until(receive.isEmergencyStopped, "emergency stop")
    dashboard.disconnect()
    control.disconnect()
    receive.disconnect()


def _unlocks(dashboard: object) -> bool:
    try:
        dashboard.unlockProtectiveStop()  # type: ignore[attr-defined]
    except RuntimeError:
        return False
    return True


def test_a_second_client_is_refused_as_the_registers_are_in_use(emulator: EmulatorProcess, host: str) -> None:
    first = rtde_control.RTDEControlInterface(host)
    with pytest.raises(RuntimeError, match="already in use"):
        rtde_control.RTDEControlInterface(host)
    first.disconnect()


def test_every_family_of_commands_works_or_is_refused(emulator: EmulatorProcess, host: str) -> None:
    receive = rtde_receive.RTDEReceiveInterface(host)
    control = rtde_control.RTDEControlInterface(host)
    start = emulator.state()["pose"]

    assert control.forceMode([0.0] * 6, [0, 0, 1, 0, 0, 0], [0, 0, -10.0, 0, 0, 0], 2, [0.02] * 6)
    wait_until(lambda: emulator.state()["pose"][2] < start[2] - 0.005, "motion by force")
    assert control.forceModeStop()
    assert control.freedriveMode()
    emulator.fault("wrench", [20.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    wait_until(lambda: emulator.state()["pose"][0] > start[0] + 0.005, "motion by hand")
    emulator.clear("wrench")
    assert control.endFreedriveMode()
    assert control.teachMode()
    assert control.endTeachMode()
    assert control.jogStart([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])
    wait_until(lambda: emulator.state()["pose"][1] > start[1] + 0.005, "jog")
    assert control.jogStop()
    assert not emulator.state()["moving"]

    q = emulator.state()["q"]
    further = [angle + 0.1 for angle in q]
    assert control.moveJ([[*further, 1.0, 2.0, 0.0], [*q, 1.0, 2.0, 0.0]])
    assert emulator.state()["q"] == pytest.approx(q, abs=1e-5)

    emulator.fault("wrench", [0.0, 0.0, 8.0, 0.0, 0.0, 0.0])
    assert control.moveUntilContact([0.0, 0.0, -0.02, 0.0, 0.0, 0.0])
    emulator.clear("wrench")
    assert control.zeroFtSensor()
    assert control.ftRtdeInputEnable(True)
    assert control.ftRtdeInputEnable(False)

    assert control.poseTrans([0.1, 0, 0, 0, 0, 0], [0, 0.1, 0, 0, 0, 1.0]) == pytest.approx([0.1, 0.1, 0, 0, 0, 1.0])
    tool = [0.0, 0.0, 0.1, 0.0, 0.0, 0.0]
    assert control.setTcp(tool)
    assert control.getForwardKinematics(q, tool)[:3] == pytest.approx(emulator.state()["position_m"], abs=1e-4)
    assert not control.getInverseKinematicsHasSolution([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert not control.isJointsWithinSafetyLimits([10.0] * 6)
    assert not control.isPoseWithinSafetyLimits([3.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert control.sendCustomScriptFunction("signal", "set_standard_digital_out(3, True)\n")
    wait_until(lambda: receive.getDigitalOutState(3), "output set by the script")

    higher = emulator.state()["pose"]
    higher[2] += 0.02
    assert control.servoC(higher, 0.1, 0.5, 0.0)
    wait_until(lambda: abs(emulator.state()["pose"][2] - higher[2]) < 1e-6, "circular servo")
    control.disconnect()
    receive.disconnect()


@pytest.mark.parametrize(("generation", "rate_hz"), [("cb3", 125.0), ("e", 500.0)])
def test_generations_have_their_own_rate_and_version(host: str, generation: str, rate_hz: float) -> None:
    with EmulatorProcess("ur", "--host", host, "--generation", generation) as emulator:
        receive = rtde_receive.RTDEReceiveInterface(host)
        dashboard = dashboard_client.DashboardClient(host)
        dashboard.connect()
        assert dashboard.polyscopeVersion().startswith("3." if generation == "cb3" else "5.")
        assert dashboard.isInRemoteControl() is (generation == "e")
        stamps = {receive.getTimestamp()}
        wait_until(lambda: stamps.add(receive.getTimestamp()) or len(stamps) > 20, "state packets")
        ticks = [round(stamp * rate_hz, 6) for stamp in stamps]
        assert all(tick == round(tick) for tick in ticks)
        control = rtde_control.RTDEControlInterface(host)
        goal = [angle + 0.02 for angle in emulator.state()["q"]]
        assert control.moveJ(goal, 1.0, 4.0)
        assert emulator.state()["q"] == pytest.approx(goal)
        control.disconnect()
        receive.disconnect()


def test_polyscope_x_has_no_dashboard(host: str) -> None:
    with EmulatorProcess("ur", "--host", host, "--generation", "x"):
        receive = rtde_receive.RTDEReceiveInterface(host)
        assert receive.getRobotMode() == 7
        with pytest.raises(RuntimeError):
            dashboard_client.DashboardClient(host).connect(500)
        receive.disconnect()


CLIENT = """
import sys, time, rtde_control
control = rtde_control.RTDEControlInterface(sys.argv[1])
if float(sys.argv[2]):
    control.setWatchdog(float(sys.argv[2]))
while True:
    control.speedL([0, 0, -0.05, 0, 0, 0], 0.5, float(sys.argv[3]))
    time.sleep(0.02)
"""


@pytest.mark.parametrize("time_s", [0.002, 0.1])
def test_without_a_watchdog_a_killed_client_leaves_the_arm_moving(
    emulator: EmulatorProcess, host: str, time_s: float
) -> None:
    _kill_in_motion(emulator, host, 0.0, time_s)
    wait_until(lambda: emulator.state()["last_command_age_s"] > 1.0, "second of silence")
    state = emulator.state()
    after_m = state["travel_since_command_m"]
    assert state["moving"], f"stopped by itself {after_m * 1e3:.1f} mm after its client was killed"
    assert after_m > 0.045, f"{after_m * 1e3:.1f} mm in {state['last_command_age_s']:.2f} s after its client was killed"


def test_with_a_watchdog_a_killed_client_stops_the_arm(emulator: EmulatorProcess, host: str) -> None:
    _kill_in_motion(emulator, host, 10.0, 0.1)
    state = emulator.wait_for(moving=False)
    after_m = state["travel_since_command_m"]
    assert after_m < 0.05 * (0.1 + 0.01) + 0.001, f"{after_m * 1e3:.2f} mm after its client was killed"
    assert state["runtime_state"] == "STOPPED"


def _kill_in_motion(emulator: EmulatorProcess, host: str, watchdog_hz: float, time_s: float) -> None:
    client = subprocess.Popen([sys.executable, "-c", CLIENT, host, str(watchdog_hz), str(time_s)])
    try:
        wait_until(lambda: emulator.state()["speed_m_s"] > 0.049, "motion")
    finally:
        client.kill()
        client.wait()
