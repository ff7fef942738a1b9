import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.geometry import se3
from touchcell.simulation.tip import Tip, TipParameters

TIP = Tip()
PUBLIC_RING_RADII_PX = [20.8, 41.2, 61.5, 81.8, 101.7, 121.3, 140.6, 159.2, 177.3, 194.0]


def contact(*pose_mm_deg: float) -> np.ndarray:
    return se3.from_euler_mm_deg(pose_mm_deg)


def test_ring_k_holds_6k_markers() -> None:
    rest = TIP.rest_positions
    assert rest.shape == (331, 3)
    np.testing.assert_allclose(np.linalg.norm(rest, axis=1), TIP.parameters.marker_radius_m)
    ring = np.round(np.arccos(rest[:, 2] / TIP.parameters.marker_radius_m) / TIP.parameters.ring_step_rad)
    assert [int((ring == k).sum()) for k in range(11)] == [1, *(6 * k for k in range(1, 11))]


def test_undeformed_rings_match_the_public_images() -> None:
    pixels = TIP.pixels(contact(0, 0, -1, 0, 0, 0))
    u, v = TIP.parameters.centre_px
    radius = np.hypot(pixels[:, 0] - u, pixels[:, 1] - v)
    assert radius[0] == pytest.approx(0.0, abs=1e-9)
    start = 1
    for k, measured in enumerate(PUBLIC_RING_RADII_PX, start=1):
        np.testing.assert_allclose(radius[start : start + 6 * k], measured, atol=0.5)
        start += 6 * k


@given(
    x=st.floats(-5, 5),
    y=st.floats(-5, 5),
    z=st.floats(-20, 0),
    alpha=st.floats(-25, 25),
    beta=st.floats(-25, 25),
    gamma=st.floats(-5, 5),
)
def test_out_of_contact_nothing_moves(x: float, y: float, z: float, alpha: float, beta: float, gamma: float) -> None:
    np.testing.assert_array_equal(TIP.marker_positions(contact(x, y, z, alpha, beta, gamma)), TIP.rest_positions)


def test_the_contacted_marker_follows_the_surface_one_to_one() -> None:
    pressed = TIP.marker_positions(contact(0, 0, 5, 0, 0, 0))
    sheared = TIP.marker_positions(contact(2, -1, 5, 0, 0, 0))
    np.testing.assert_allclose((sheared - pressed)[0], [-0.002, 0.001, 0.0], atol=1e-12)


def test_shear_falls_off_towards_the_rim_but_not_to_nothing() -> None:
    shift = TIP.marker_positions(contact(2, 0, 5, 0, 0, 0)) - TIP.marker_positions(contact(0, 0, 5, 0, 0, 0))
    share = -shift[:, 0] / 0.002
    polar = np.arccos(TIP.rest_positions[:, 2] / TIP.parameters.marker_radius_m)
    by_angle = share[np.argsort(polar, kind="stable")]
    assert (np.diff(by_angle) <= 1e-12).all()
    assert 0.2 < by_angle[-1] < 0.4


def test_shear_raises_one_flank_and_lowers_the_other() -> None:
    shift = TIP.marker_positions(contact(2, 0, 5, 0, 0, 0)) - TIP.marker_positions(contact(0, 0, 5, 0, 0, 0))
    x = TIP.rest_positions[:, 0]
    ahead, behind = shift[x < -0.01, 2], shift[x > 0.01, 2]
    assert (ahead < 0).all()
    assert (behind > 0).all()


def test_torsion_turns_the_contacted_markers_back_by_a_share() -> None:
    turned = TIP.marker_positions(contact(0, 0, 5, 0, 0, 5))
    pressed = TIP.marker_positions(contact(0, 0, 5, 0, 0, 0))
    inner = slice(1, 7)
    before = np.arctan2(pressed[inner, 1], pressed[inner, 0])
    after = np.arctan2(turned[inner, 1], turned[inner, 0])
    turn = np.degrees(np.angle(np.exp(1j * (after - before))))
    np.testing.assert_allclose(turn, -5 * TIP.parameters.torsion_follow, rtol=0.1)


def test_pressing_dents_the_apex_and_tilted_pressing_leans_the_dome() -> None:
    straight = TIP.marker_positions(contact(0, 0, 4, 0, 0, 0)) - TIP.rest_positions
    assert straight[0, 2] < -0.004
    np.testing.assert_allclose(straight[:, :2].sum(axis=0), 0.0, atol=1e-12)
    T = contact(0, 0, 4, 0, 20, 0)
    inward = T[2, :3]
    tilted = TIP.marker_positions(T) - TIP.rest_positions
    assert tilted.mean(axis=0)[:2] @ inward[:2] < -1e-4


def test_pins_amplify_the_turn_of_the_skin() -> None:
    T = contact(0, 0, 4, 0, 0, 0)
    short = Tip(TipParameters(pin_lever_m=0.0)).marker_positions(T)
    swing = TIP.marker_positions(T) - short
    outward = np.einsum("ij,ij->i", swing[:, :2], TIP.rest_positions[:, :2])
    assert (outward[1:] > 0).all()


@pytest.mark.parametrize("sixths", [1, 2, 5])
def test_rotating_the_contact_about_the_sensor_axis_rotates_the_field(sixths: int) -> None:
    Z = contact(0, 0, 0, 0, 0, 60.0 * sixths)[:3, :3]
    T = contact(1.5, -2.0, 4.0, 10.0, -15.0, 0.0)
    R, shear = T[:3, :3], T[:3, :3].T @ np.array([T[0, 3], T[1, 3], 0.0])
    inward = Z @ R[2]
    beta = -math.asin(inward[0])
    alpha = math.atan2(inward[1], inward[2])
    turned = contact(0, 0, 4.0, math.degrees(alpha), math.degrees(beta), 0.0)
    turned[:2, 3] = (turned[:3, :3] @ Z @ shear)[:2]
    expected = TIP.marker_positions(T) @ Z.T
    found = TIP.marker_positions(turned)
    distances = np.linalg.norm(expected[:, None] - found[None], axis=2)
    assert distances.min(axis=1).max() < 1e-12
    assert len(set(distances.argmin(axis=1).tolist())) == 331


def test_a_batch_is_its_members() -> None:
    batch = np.stack([contact(1, 2, 4, 5, 6, 3), contact(0, 0, -1, 0, 0, 0), contact(-2, 1, 5.5, -20, 3, -4)])
    together = TIP.pixels(batch[None])[0]
    assert together.shape == (3, 331, 2)
    for T, pixels in zip(batch, together, strict=True):
        np.testing.assert_allclose(TIP.pixels(T), pixels, atol=1e-9)


def test_the_camera_is_a_pinhole_behind_the_sphere() -> None:
    p = TIP.parameters
    on_axis = TIP.project(np.array([0.0, 0.0, 0.01]))
    np.testing.assert_allclose(on_axis, p.centre_px)
    near, far = (TIP.project(np.array([0.01, 0.0, z])) - p.centre_px for z in (0.0, 0.02))
    assert np.hypot(*near) == pytest.approx(p.focal_px * 0.01 / p.camera_distance_m)
    assert np.hypot(*far) < np.hypot(*near)
    assert math.atan2(near[1], near[0]) == pytest.approx(p.image_rotation_rad)


def test_a_mirrored_camera_reverses_the_image_about_its_vertical_axis() -> None:
    straight, mirrored = (
        Tip(TipParameters(image_rotation_rad=0.4)),
        Tip(TipParameters(image_rotation_rad=0.4, mirrored=True)),
    )
    u = straight.parameters.centre_px[0]
    places = straight.marker_positions(contact(1.5, -2.0, 4.0, 10.0, -15.0, 3.0))
    np.testing.assert_allclose(mirrored.project(places), [2.0 * u, 0.0] + straight.project(places) * [-1.0, 1.0])
