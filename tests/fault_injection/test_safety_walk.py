"""Random operators, faults and timing against a running simulated cell: safety invariants always hold.

The length of the walk is set for CI; ``TOUCHCELL_WALK`` multiplies it (with ``--timeout 0``).
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

from tests.fault_injection.fault_matrix import cells, on_true_contact
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.black_box import BlackBox
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.drivers.core.device import Lifecycle
from touchcell.simulation.devices.arm import SimArm

LONGER = int(os.environ.get("TOUCHCELL_WALK", "1"))
SLACK_S = 0.05


class SafetyWalk(RuleBasedStateMachine):
    """A cell on true contacts, stepped by rules.

    The arms' own simulation is the ground truth, not their reported state.
    """

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.result: Any = None

    @initialize(
        task=st.sampled_from(["surface_following", "object_tracking", "single_arm_pushing", "dual_arm_pushing"]),
        category=st.sampled_from([1, 2]),
    )
    def start(self, task: str, category: int) -> None:
        data = on_true_contact(cells()[task])
        for section in data["arms"].values():
            section["stop_category"] = category
        path = Path(self.folder.name) / "cell.yaml"
        path.write_text(yaml.safe_dump(data))
        self.cell = compose(plan_cell(path))
        self.cell.__enter__()
        self.arms: dict[str, SimArm] = dict(self.cell.arms)
        assert all(isinstance(arm, SimArm) for arm in self.arms.values())
        self.stop = StopRequest()
        self.box = BlackBox()
        self.loop = RunLoop(self.cell, None, box=self.box, stop=self.stop)
        self.streamed = 0
        self.streamed_ns: dict[str, int] = {}
        for role in self.arms:
            self.watch(role)
        self.latched_ns: int | None = None
        self.going = True
        self.disobeyed: set[str] = set()
        self.loop.begin()

    def watch(self, role: str) -> None:
        """Record every twist that the arm in ``role`` receives."""
        arm = self.arms[role]
        follow = arm._body.follow

        def watched(twist: Any, expires_ns: int) -> None:
            assert np.isfinite(twist).all()
            assert self.latched_ns is None, "a command after the latch"
            assert np.linalg.norm(twist[:3]) <= arm.limits.speed_m_s * (1 + 1e-9)
            self.streamed += 1
            self.streamed_ns[role] = self.cell.clock.now_ns()
            follow(twist, expires_ns)

        arm._body.follow = watched  # type: ignore[method-assign]

    def running(self) -> bool:
        return self.result is None

    @precondition(running)
    @rule(cycles=st.integers(1, 60))
    def run_on(self, cycles: int) -> None:
        for _ in range(cycles):
            if not self.going:
                self.end()
                return
            self.going = self.loop.step()
            if self.latched_ns is None and self.cell.supervisor.latch.first_cause is not None:
                self.latched_ns = self.cell.clock.now_ns()

    @precondition(running)
    @rule(now=st.booleans())
    def operator(self, now: bool) -> None:
        if now:
            self.stop.ask_at_once()
        else:
            self.stop.ask()

    @precondition(running)
    @rule(
        which=st.integers(0, 1),
        change=st.sampled_from(
            [
                {"nan_state": True},
                {"stale": True},
                {"stale": False},
                {"ignores_stops": True},
                {"ignores_expiry": True},
                {"ignores_expiry": False, "ignores_stops": False},
                {"drift_m_s": 0.03},
                {"drift_m_s": 0.0},
            ]
        ),
    )
    def fault(self, which: int, change: dict[str, Any]) -> None:
        role = sorted(self.arms)[which % len(self.arms)]
        self.arms[role].faults = replace(self.arms[role].faults, **change)
        if any(change.get(name) for name in ("ignores_expiry", "drift_m_s")):
            self.disobeyed.add(role)

    @precondition(running)
    @rule(pause_ms=st.integers(1, 400))
    def late(self, pause_ms: int) -> None:
        """The machine is busy: no cycle for a while."""
        self.cell.clock.sleep_until_ns(self.cell.clock.now_ns() + pause_ms * 1_000_000)

    @precondition(lambda self: self.result is not None)
    @rule(seconds=st.floats(0.01, 1.0))
    def look_on(self, seconds: float) -> None:
        """Once a run has ended nothing moves."""
        before = {role: arm.T_world_tcp() for role, arm in self.arms.items()}
        self.cell.clock.sleep_until_ns(self.cell.clock.now_ns() + round(1e9 * seconds))
        for role, arm in self.arms.items():
            arm._timeline.advance()
            if role not in self.disobeyed:
                np.testing.assert_array_equal(arm.T_world_tcp(), before[role])

    def end(self) -> None:
        faults = {role: arm.faults for role, arm in self.arms.items()}
        sent = self.streamed
        self.result = self.loop.end()
        assert self.streamed == sent, "a command while stopping"
        trip = self.cell.supervisor.latch.first_cause
        assert (self.result.outcome is Outcome.TRIPPED) == (trip is not None)
        for role, arm in self.arms.items():
            report = self.result.stops[role]
            if not (faults[role].ignores_stops or faults[role].ignores_expiry or faults[role].drift_m_s):
                assert report.kept or report.time_s <= report.declared_s + 1.0 / self.cell.rate_hz
                assert not report.escalated
            if not faults[role].ignores_stops:
                assert arm.at_rest()
                assert report.time_s is not None
            assert arm.owner is None

    @invariant()
    def never_moves_without_a_fresh_command(self) -> None:
        if not hasattr(self, "arms"):
            return
        for role in self.arms.keys() - self.disobeyed:
            arm, limits = self.arms[role], self.arms[role].limits
            quiet_s = 1e-9 * (self.cell.clock.now_ns() - self.streamed_ns.get(role, 0))
            braking_s = max(limits.speed_m_s / limits.accel_m_s2, limits.rot_speed_rad_s / limits.rot_accel_rad_s2)
            arm._timeline.advance()
            if quiet_s > 0.03 + SLACK_S + braking_s:
                assert arm._body.at_rest()

    @invariant()
    def the_latch_and_the_task_agree(self) -> None:
        if hasattr(self, "cell") and self.cell.supervisor.latch.first_cause is not None:
            assert self.cell.task.finished or self.result is not None
            assert all(arm.state in (Lifecycle.ACTIVE, Lifecycle.READY) for arm in self.arms.values())

    def teardown(self) -> None:
        if hasattr(self, "cell"):
            if self.result is None:
                self.end()
            for arm in self.arms.values():
                arm.faults = replace(arm.faults, ignores_stops=False, ignores_expiry=False, drift_m_s=0.0)
            self.cell.__exit__(None, None, None)
            self.box.close()
        self.folder.cleanup()


TestSafetyWalk = SafetyWalk.TestCase
TestSafetyWalk.settings = settings(max_examples=20 * LONGER, stateful_step_count=15)
