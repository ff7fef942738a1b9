"""The suite itself: it passes an honest driver, finds what is wrong with bad ones, and runs on a cell's devices."""

from __future__ import annotations

import pytest

import touchcell.cell.config.schema
import touchcell.simulation.devices.rig  # noqa: F401  a run inside a test forgets what it was the first to import
from touchcell.paths import CONFIGS

pytest_plugins = ["pytester"]

BAD_RIG = """
import dataclasses
import numpy as np
from touchcell.testing.conformance.suite import suite
from touchcell.simulation.devices.rig import sim_arm_rig
from touchcell.simulation.devices.arm import SimArm
from touchcell.drivers.core import protocols

{change}

def rig(folder, address):
    return broken(sim_arm_rig(folder, address))

TestArm = suite(rig)
"""


def failures(pytester: pytest.Pytester, change: str) -> set[str]:
    """Names of the checks that fail for a simulated arm that is changed so."""
    pytester.makepyfile(test_bad=BAD_RIG.format(change=change))
    result = pytester.runpytest("-q", "-p", "no:cacheprovider")
    reports = [line for line in result.outlines if line.startswith(("FAILED", "ERROR"))]
    return {line.split("::test_")[1].split(" ")[0].split("[")[0] for line in reports}


def test_an_honest_driver_passes(pytester: pytest.Pytester) -> None:
    assert failures(pytester, "def broken(rig): return rig") == set()


def test_a_driver_that_turns_the_wrong_way_is_found(pytester: pytest.Pytester) -> None:
    change = """
class Wrong(SimArm):
    def _stream_twist(self, twist_base, ttl_s, now_ns):
        super()._stream_twist(twist_base * [1, 1, 1, 1, 1, -1], ttl_s, now_ns)

def broken(rig):
    original = rig.build
    def build(clock):
        arm = original(clock)
        arm.__class__ = Wrong
        return arm
    return dataclasses.replace(rig, build=build)
"""
    assert failures(pytester, change) == {"twists_along_base_axes_are_followed", "twists_along_tool_axes_are_followed"}


def test_a_driver_that_forgets_the_time_to_live_is_found(pytester: pytest.Pytester) -> None:
    change = """
class Wrong(SimArm):
    def _stream_twist(self, twist_base, ttl_s, now_ns):
        super()._stream_twist(twist_base, 30.0, now_ns)

def broken(rig):
    original = rig.build
    def build(clock):
        arm = original(clock)
        arm.__class__ = Wrong
        return arm
    return dataclasses.replace(rig, build=build)
"""
    assert "time_to_live_stops_the_motion" in failures(pytester, change)


def test_a_driver_that_energises_when_it_connects_is_found(pytester: pytest.Pytester) -> None:
    change = """
def broken(rig):
    connections = []
    original, start = rig.build, rig.start
    def build(clock):
        arm = original(clock)
        opened = arm._open
        arm._open = lambda: (connections.append(1), opened())
        return arm
    def begin():
        stand_in = start()
        truth = stand_in.state
        stand_in.state = lambda: {**truth(), "energising": len(connections)}
        return stand_in
    return dataclasses.replace(rig, build=build, start=begin, energising="energising")
"""
    assert failures(pytester, change) == {"connect_never_energises"}


def test_a_record_that_promises_too_much_is_found(pytester: pytest.Pytester) -> None:
    change = """
def broken(rig):
    capabilities = dataclasses.replace(
        rig.spec.capabilities,
        provides=rig.spec.capabilities.provides | {protocols.NativeWatchdog},
        stop_categories=frozenset({0, 1, 2}),
    )
    return dataclasses.replace(rig, spec=dataclasses.replace(rig.spec, capabilities=capabilities))
"""
    found = failures(pytester, change)
    assert {
        "protocols_are_those_of_the_record",
        "record_of_the_watchdog_is_consistent",
        "stop_categories_are_those_of_the_record",
        "watchdog_is_read_back",
    } == found


def test_a_failure_known_by_name_is_reported_separately(pytester: pytest.Pytester) -> None:
    change = """
def broken(rig):
    capabilities = dataclasses.replace(rig.spec.capabilities, max_watchdog_s=0.1)
    spec = dataclasses.replace(rig.spec, capabilities=capabilities)
    return dataclasses.replace(rig, spec=spec, known={"record_of_the_watchdog_is_consistent": "nobody is perfect"})
"""
    pytester.makepyfile(test_bad=BAD_RIG.format(change=change))
    result = pytester.runpytest("-q", "-k", "record_of_the_watchdog")
    result.assert_outcomes(xfailed=1)
    result.stdout.fnmatch_lines(["*record_of_the_watchdog_is_consistent*known*", "*nobody is perfect*"])


CELL = CONFIGS / "surface_follow_sim.yaml"


def test_devices_of_a_cell_are_tested_at_creeping_speed(pytester: pytest.Pytester) -> None:
    bench = pytester.path / "bench.yaml"
    bench.write_text(CELL.read_text())
    result = pytester.runpytest("-m", "hil", "--cell", str(bench), "--hil-yes", "-v", "-p", "no:cacheprovider")
    assert result.ret == pytest.ExitCode.OK
    result.stdout.fnmatch_lines(["*Test_arm::test_time_to_live_stops_the_motion PASSED*"])
    result.stdout.fnmatch_lines(["*Test_sensor::test_frames_are_stamped_and_numbered PASSED*"])
    result.stdout.fnmatch_lines(["*Test_arm::test_killed_client_leaves_the_arm_at_rest SKIPPED*"])


def test_the_operator_is_asked_and_may_refuse(pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = pytester.path / "bench.yaml"
    bench.write_text(CELL.read_text())
    asked = []
    monkeypatch.setattr("builtins.input", lambda *_: asked.append(1) or "no")
    result = pytester.runpytest("-m", "hil", "--cell", str(bench), "-p", "no:cacheprovider")
    assert len(asked) == 1
    assert result.ret == pytest.ExitCode.INTERRUPTED
    result.assert_outcomes()


def test_without_a_cell_hil_tests_are_deselected(pytester: pytest.Pytester) -> None:
    pytester.makepyfile("import pytest\n\n@pytest.mark.hil\ndef test_moves_metal():\n    raise AssertionError\n")
    pytester.runpytest().assert_outcomes(deselected=1)
