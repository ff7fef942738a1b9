"""Random operators, faults and timing against a running simulated cell: what must never happen does not.

The bound of the walk is set for CI; ``TOUCHCELL_WALK`` multiplies it.
"""

from __future__ import annotations

import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from benchmarks.fault_matrix import cells
from cell.blackbox import BlackBox
from cell.compose import compose
from cell.config import plan_cell
from cell.loop import Outcome, RunLoop, StopRequest
from drivers.device import Lifecycle
from drivers.sim_arm import SimArm

LONGER = int(os.environ.get("TOUCHCELL_WALK", "1"))
SLACK_S = 0.05


class SafetyWalk(RuleBasedStateMachine):
    """A cell on true contacts, stepped by rules. The arm's own simulation is what is believed, not what it tells."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.result: Any = None

    @initialize(
        task=st.sampled_from(["surface_following", "object_tracking", "single_arm_pushing"]),
        category=st.sampled_from([1, 2]),
    )
    def start(self, task: str, category: int) -> None:
        data = cells()[task]
        data["sensors"]["sensor"]["estimator"] = {"kind": "true_contact"}
        data["arms"]["arm"]["stop_category"] = category
        path = Path(self.folder.name) / "cell.yaml"
        path.write_text(yaml.safe_dump(data))
        self.cell = compose(plan_cell(path))
        self.cell.__enter__()
        arm = self.cell.arms["arm"]
        assert isinstance(arm, SimArm)
        self.arm = arm
        self.stop = StopRequest()
        self.box = BlackBox()
        self.loop = RunLoop(self.cell, None, box=self.box, stop=self.stop)
        self.streamed_ns: list[int] = []
        follow = arm._body.follow

        def watched(twist: Any, expires_ns: int) -> None:
            assert np.isfinite(twist).all()
            assert self.latched_ns is None, "a command after the latch"
            assert np.linalg.norm(twist[:3]) <= arm.limits.speed_m_s * (1 + 1e-9)
            self.streamed_ns.append(self.cell.clock.now_ns())
            follow(twist, expires_ns)

        arm._body.follow = watched  # type: ignore[method-assign]
        self.latched_ns: int | None = None
        self.going = True
        self.disobeyed = False
        self.loop.begin()

    def going_on(self) -> bool:
        return self.result is None

    @precondition(going_on)
    @rule(cycles=st.integers(1, 60))
    def run_on(self, cycles: int) -> None:
        for _ in range(cycles):
            if not self.going:
                self.end()
                return
            self.going = self.loop.step()
            if self.latched_ns is None and self.cell.supervisor.latch.first_cause is not None:
                self.latched_ns = self.cell.clock.now_ns()

    @precondition(going_on)
    @rule(now=st.booleans())
    def operator(self, now: bool) -> None:
        if now:
            self.stop.ask_at_once()
        else:
            self.stop.ask()

    @precondition(going_on)
    @rule(
        change=st.sampled_from(
            [
                {"nan_state": True},
                {"stale": True},
                {"stale": False},
                {"deaf": True},
                {"runs_on": True},
                {"runs_on": False, "deaf": False},
                {"drift_m_s": 0.03},
                {"drift_m_s": 0.0},
            ]
        )
    )
    def fault(self, change: dict[str, Any]) -> None:
        self.arm.faults = replace(self.arm.faults, **change)
        self.disobeyed |= any(change.get(name) for name in ("runs_on", "drift_m_s"))

    @precondition(going_on)
    @rule(pause_ms=st.integers(1, 400))
    def late(self, pause_ms: int) -> None:
        """The machine is busy: no cycle for a while."""
        self.cell.clock.sleep_until_ns(self.cell.clock.now_ns() + pause_ms * 1_000_000)

    @precondition(lambda self: self.result is not None)
    @rule(seconds=st.floats(0.01, 1.0))
    def look_on(self, seconds: float) -> None:
        """Once a run has ended nothing moves, whatever it was."""
        before = self.arm.T_world_tcp()
        self.cell.clock.sleep_until_ns(self.cell.clock.now_ns() + round(1e9 * seconds))
        self.arm._timeline.advance()
        if not self.disobeyed:
            np.testing.assert_array_equal(self.arm.T_world_tcp(), before)

    def end(self) -> None:
        obeys = not (self.arm.faults.deaf or self.arm.faults.runs_on or self.arm.faults.drift_m_s)
        sent = len(self.streamed_ns)
        self.result = self.loop.end()
        assert len(self.streamed_ns) == sent, "a command while stopping"
        trip = self.cell.supervisor.latch.first_cause
        assert (self.result.outcome is Outcome.TRIPPED) == (trip is not None)
        report = self.result.stops["arm"]
        if obeys:
            assert report.kept or report.time_s <= report.declared_s + 1.0 / self.cell.rate_hz
            assert not report.escalated
        if not self.arm.faults.deaf:
            assert self.arm.at_rest()
            assert report.time_s is not None
        assert self.arm.owner is None

    @invariant()
    def never_moves_without_a_fresh_command(self) -> None:
        if not hasattr(self, "arm") or self.disobeyed:
            return
        now_ns = self.cell.clock.now_ns()
        quiet_s = 1e-9 * (now_ns - (self.streamed_ns[-1] if self.streamed_ns else 0))
        limits = self.arm.limits
        longest_s = (
            0.03 + SLACK_S + max(limits.speed_m_s / limits.accel_m_s2, limits.rot_speed_rad_s / limits.rot_accel_rad_s2)
        )
        self.arm._timeline.advance()
        if quiet_s > longest_s:
            assert self.arm._body.at_rest()

    @invariant()
    def the_latch_and_the_task_agree(self) -> None:
        if hasattr(self, "cell") and self.cell.supervisor.latch.first_cause is not None:
            assert self.cell.task.finished or self.result is not None
            assert self.arm.state in (Lifecycle.ACTIVE, Lifecycle.READY)

    def teardown(self) -> None:
        if hasattr(self, "cell"):
            if self.result is None:
                self.end()
            self.arm.faults = replace(self.arm.faults, deaf=False, runs_on=False, drift_m_s=0.0)
            self.cell.__exit__(None, None, None)
        self.folder.cleanup()


TestSafetyWalk = SafetyWalk.TestCase
TestSafetyWalk.settings = settings(max_examples=20 * LONGER, stateful_step_count=15, deadline=None)
