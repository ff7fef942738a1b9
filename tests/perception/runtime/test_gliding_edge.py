"""The filter of edges: {e} glides along with the tip and turns with the edge's bend."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.geometry.types import Array
from touchcell.perception.runtime.gliding_edge import GlidingEdgeConfig, GlidingEdgeFilter

RADIUS_M = 0.05
FRAME_NS = 33_333_333
MOST_MM_DEG = np.array([0.15, 0.1, 0.05, 0.5, 0.5, 1.0])
CONTACT = np.array([0.3, 0.0, 3.0, 0.5, -0.5, 2.0])
SIGMA = MOST_MM_DEG * np.repeat([1e-3, math.radians(1.0)], 3)


def edge_of_disc(way_m: float) -> Array:
    """T_base_e (4, 4) on the rim of a disc, after so much of it."""
    angle = -way_m / RADIUS_M
    T = np.eye(4)
    out = np.array([math.cos(angle), math.sin(angle), 0.0])
    T[:3, 0], T[:3, 2] = out, (0.0, 0.0, -1.0)
    T[:3, 1] = np.cross(T[:3, 2], out)
    T[:3, 3] = RADIUS_M * out
    return T


def frames(
    edge: Callable[[float], Array], n: int, noise: np.random.Generator | None = None
) -> Iterator[tuple[PoseGaussian, Array, int]]:
    """Observations each 1 mm along an edge, the sensor's pose and the time."""
    for i in range(n):
        T_base_s = se3.compose(edge(1e-3 * i), se3.from_euler_mm_deg(CONTACT))
        seen = CONTACT if noise is None else CONTACT + noise.normal(0.0, MOST_MM_DEG)
        yield PoseGaussian(se3.inverse(se3.from_euler_mm_deg(seen)), np.diag(SIGMA**2)), T_base_s, i * FRAME_NS


def contact_of(belief: PoseGaussian) -> Array:
    return se3.to_euler_mm_deg(se3.inverse(belief.mean))


def test_a_bend_is_learned_and_predicted() -> None:
    pose_filter = GlidingEdgeConfig().build()
    for observed, T_base_s, t_ns in frames(edge_of_disc, 40):
        pose_filter.update(observed, T_base_s, t_ns)
    assert pose_filter.bend_per_m[2] == pytest.approx(1.0 / RADIUS_M, rel=0.05)
    ahead = pose_filter.predict(se3.compose(edge_of_disc(44e-3), se3.from_euler_mm_deg(CONTACT)), 43 * FRAME_NS)
    # 5 mm on it has turned by 5.7 deg.
    np.testing.assert_allclose(contact_of(ahead), CONTACT, atol=0.3)


def test_it_is_less_noisy_than_what_it_is_told_and_as_sure_as_it_may_be() -> None:
    pose_filter, told, believed, inside = GlidingEdgeConfig().build(), [], [], []
    for i, (observed, T_base_s, t_ns) in enumerate(frames(edge_of_disc, 400, np.random.default_rng(1))):
        state = pose_filter.update(observed, T_base_s, t_ns)
        if i > 20:
            told.append(contact_of(observed) - CONTACT)
            believed.append(contact_of(state.belief) - CONTACT)
            inside.append(np.abs(believed[-1][5]) < 2.0 * np.degrees(math.sqrt(state.belief.covariance[5, 5])))
    raw, filtered = np.sqrt(np.mean(np.square(told), axis=0)), np.sqrt(np.mean(np.square(believed), axis=0))
    assert (filtered[[0, 3, 4, 5]] < 0.9 * raw[[0, 3, 4, 5]]).all()
    assert filtered[2] < raw[2]
    assert np.mean(inside) > 0.9


def test_a_corner_begins_anew() -> None:
    pose_filter = GlidingEdgeConfig().build()
    for observed, T_base_s, t_ns in frames(edge_of_disc, 20):
        pose_filter.update(observed, T_base_s, t_ns)
    T_e_s = se3.from_euler_mm_deg(CONTACT + np.array([1.0, 0.0, 0.0, 0.0, 0.0, 60.0]))
    turned = PoseGaussian(se3.inverse(T_e_s), np.diag(SIGMA**2))
    state = pose_filter.update(turned, T_base_s, t_ns + FRAME_NS)
    assert state.belief is turned
    assert not pose_filter.bend_per_m.any()


def test_the_frame_of_the_base_does_not_matter() -> None:
    def beliefs(T: Array, pose_filter: GlidingEdgeFilter) -> list[Array]:
        rng = np.random.default_rng(3)
        return [pose_filter.update(o, se3.compose(T, at), t).belief.mean for o, at, t in frames(edge_of_disc, 30, rng)]

    other = se3.from_euler_mm_deg([300.0, -200.0, 100.0, 20.0, -70.0, 130.0])
    one, two = beliefs(np.eye(4), GlidingEdgeConfig().build()), beliefs(other, GlidingEdgeConfig().build())
    np.testing.assert_allclose(two, one, atol=1e-9)
