"""An arm is let go slowly, and its motors are disabled when nothing moves any more."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.drivers.damiao.fade import FADE_S, LONGEST_S, Fade

REST = np.array([0.1, -0.8, 1.2])


def test_stiffness_goes_down_to_none_and_the_motors_stay_enabled_for_a_second_of_rest() -> None:
    fade = Fade(REST, 5.0)
    shares = [fade.share(REST, 5.0 + t) for t in (0.0, FADE_S / 2, FADE_S, FADE_S + 0.9)]
    assert shares == pytest.approx([1.0, 0.5, 0.0, 0.0])
    assert fade.share(REST, 5.0 + FADE_S + 1.1) is None


@pytest.mark.parametrize("joint", range(3))
def test_the_motors_damp_while_any_joint_still_sinks(joint: int) -> None:
    fade = Fade(REST, 0.0)
    q = REST.copy()
    for t in np.arange(0.0, FADE_S + 5.0, 0.02):
        q[joint] -= np.deg2rad(0.5) * 0.02
        assert fade.share(q, float(t)) is not None
    assert fade.share(q, FADE_S + 6.2) is None


def test_an_arm_that_never_comes_to_rest_is_let_go_at_last() -> None:
    fade = Fade(REST, 0.0)
    for t in np.arange(0.0, LONGEST_S, 0.1):
        assert fade.share(REST + t, float(t)) is not None
    assert fade.share(REST + LONGEST_S, LONGEST_S + 0.1) is None
