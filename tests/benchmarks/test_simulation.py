import time

import numpy as np
import pytest

from benchmarks import simulation_scripts
from benchmarks.cpu_shares import cpu_shares
from benchmarks.simulation_checks import uniform_pressure_yaw
from benchmarks.simulation_scripts import Script, perform

pytest.importorskip("mujoco")

PRESS = Script(
    {"surfaces": {"floor": {"kind": "plane", "pose_mm_deg": (0, 0, 200, 0, 0, 0)}}},
    {"left": (0, 0, 220.2, 180, 0, 0)},
    ((0.3, {"left": (0, 0, 10, 0, 0, 0)}), (0.2, {"left": (5, 0, 0, 0, 0, 0)}), (0.1, {})),
    tool="straight",
)


def test_a_script_is_the_same_with_tips_and_with_arms_but_for_their_sag() -> None:
    tips, again, arms = (perform(PRESS, "dynamic", joints=joints) for joints in (False, False, True))
    np.testing.assert_array_equal(tips.shear_mm, again.shear_mm)
    assert tips.shear_mm.shape == (60, 1, 2)
    assert tips.shear_mm[-1, 0, 0] == pytest.approx(1.0, abs=0.1)
    assert tips.duration_s == pytest.approx(0.6)
    np.testing.assert_allclose(arms.shear_mm, tips.shear_mm, atol=0.4)
    assert 0.5 * tips.force_n[-1, 0] < arms.force_n[-1, 0] < tips.force_n[-1, 0]


def test_every_script_names_tips_that_it_moves() -> None:
    for script in simulation_scripts.SCRIPTS.values():
        for seconds, twists in script.moves:
            assert seconds > 0.0
            assert twists.keys() <= script.start_mm_deg.keys()


def test_a_push_through_the_centre_does_not_turn_the_object() -> None:
    assert uniform_pressure_yaw(np.array([0.08, 0.08]), np.array([-0.04, 0.0]), 0.05) == pytest.approx(0.0, abs=1e-6)
    to_the_left = uniform_pressure_yaw(np.array([0.08, 0.08]), np.array([-0.04, 0.01]), 0.05)
    assert to_the_left < -0.2
    assert uniform_pressure_yaw(np.array([0.08, 0.08]), np.array([-0.04, -0.01]), 0.05) == pytest.approx(-to_the_left)


def test_time_is_attributed_to_its_stage() -> None:
    with cpu_shares({"tests/benchmarks/test_simulation": "here", "simulation_checks": "there"}, "elsewhere") as counts:
        until = time.process_time() + 5.0
        while counts["here"] < 10 and time.process_time() < until:
            pass
    assert counts["here"] >= 10
    assert counts["there"] == counts["elsewhere"] == 0
