"""The figures of a step response against one that is known."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.steps import response


def test_a_damped_oscillation_has_its_known_rise_overshoot_and_settling() -> None:
    t_s = np.arange(-0.5, 3.0, 0.001)
    damping, natural = 0.5, 10.0
    damped = natural * np.sqrt(1.0 - damping**2)
    decay = np.exp(-damping * natural * t_s)
    error = 2.0 * decay * (np.cos(damped * t_s) + damping * natural / damped * np.sin(damped * t_s))
    found = response(t_s, np.where(t_s < 0.0, 0.0, error), 2.0)
    assert found["largest"] == pytest.approx(2.0, rel=0.01)
    assert found["overshoot_percent"] == pytest.approx(16.3, abs=0.5)
    assert found["rise_s"] == pytest.approx(0.216, abs=0.01)
    # Where 1.1547 exp(-5 t) cos(8.66 t - pi / 6) comes back to -0.1.
    assert found["settled_s"] == pytest.approx(0.471, abs=0.005)
    assert found["left"] == pytest.approx(0.0, abs=0.01)
