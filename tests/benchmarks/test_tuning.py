"""The tuning benchmark against known results for sampled loops."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.tuning import alignment_answer, dies_away, margin, servo_answer, settling
from touchcell.tasks.single_arm_pushing import SingleArmPushingConfig

PUSH = SingleArmPushingConfig(target_mm=(300.0, 0.0))


@pytest.mark.parametrize("latency_ms", [0.0, 10.0, 20.0])
def test_a_proportional_loops_margin_is_the_known_one(latency_ms):
    """x moves by -k x held for T = 50 ms, measured d ago: stable below 2 / (T - 2 d) and 1 / d."""
    T, d = 0.05, 1e-3 * latency_ms
    known = min(2.0 / (T - 2.0 * d), 1.0 / d if d else np.inf)
    assert margin(servo_answer(PUSH, 3), 20.0, latency_ms) == pytest.approx(known / PUSH.kp_per_s[3], rel=0.06)


def test_steering_ends_on_the_path_and_has_margin():
    answer = alignment_answer(PUSH)
    errors = answer(1.0, 30.0, 10.0)
    assert abs(errors[-1]) < 0.05
    assert settling(errors)["overshoot_percent"] < 30.0
    assert dies_away(answer(3.0, 30.0, 30.0), len(errors))
