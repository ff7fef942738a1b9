"""The state of another point of the same tool."""

from __future__ import annotations

import numpy as np

from touchcell.drivers.core.samples import TcpState, of_other_point
from touchcell.geometry import se3


def test_a_point_on_a_lever_moves_by_rotation_too() -> None:
    T_base_tcp = se3.from_euler_mm_deg(np.array([100.0, 0, 0, 0, 0, 0]))
    T_base_tip = se3.from_euler_mm_deg(np.array([100.0, 0, 50.0, 0, 0, 0]))
    state = of_other_point(TcpState(T_base_tcp, np.array([0.01, 0, 0, 0, 2.0, 0])), T_base_tip)
    np.testing.assert_array_equal(state.T_base_tcp, T_base_tip)
    np.testing.assert_allclose(state.twist, [0.01 + 2.0 * 0.05, 0, 0, 0, 2.0, 0])
