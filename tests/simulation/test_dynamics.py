import sys

import numpy as np
import pytest
from pydantic import ValidationError

from benchmarks.simulation_checks import GRAVITY_M_S2, CommandedTip, uniform_pressure_yaw
from touchcell.drivers.core.clock import VirtualClock
from touchcell.drivers.core.scene import ContactState
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.scene import SceneConfig

mujoco = pytest.importorskip("mujoco")

STILL = (0, 0, 0, 0, 0, 0)


def parts(state: ContactState) -> np.ndarray:
    return se3.to_euler_mm_deg(state.T_f_s)


FLOOR = {"surfaces": {"floor": {"kind": "plane"}}}
ABOVE = (0, 0, 20.5, 180, 0, 0)
PRISM = {"shape": {"kind": "box", "size_mm": [80, 80, 60]}, "mass_g": 479}
# The tip looks along +x at the prism's face, 0.5 mm before it.
BEHIND = (-60.5, 0, 30, 0, 90, 0)


def test_a_sticking_contact_equals_that_of_the_kinematic_scene() -> None:
    script = [((0, 0, 10, 0, 0, 0), 0.45), ((4, 0, 0, 0, 0, 0), 0.4), ((0, 0, 0, 0, 0, 5), 0.5)]
    script += [((0, 0, 0, 20, 0, 0), 0.4), ((0, -5, 0, 0, 0, 0), 0.2), (STILL, 0.2)]
    hands = [CommandedTip(FLOOR, ABOVE, physics) for physics in ("kinematic", "dynamic")]
    for twist, seconds in script:
        law, physics = (hand.move(twist, seconds) for hand in hands)
        assert law.in_contact
        assert physics.in_contact
        np.testing.assert_allclose(parts(physics), parts(law), atol=0.06)
        np.testing.assert_allclose(physics.T_world_f, law.T_world_f, atol=1e-3)
        assert not physics.slipping


def test_a_sliding_contact_keeps_the_shear_that_friction_holds() -> None:
    hand = CommandedTip({**FLOOR, "tip": {"friction": 0.5}}, ABOVE)
    hand.move((0, 0, 10, 0, 0, 0), 0.35)
    assert hand.move((20, 0, 0, 0, 0, 0), 0.5).slipping
    state = hand.move((2, 0, 0, 0, 0, 0), 0.3)
    assert state.slipping
    # 1.5 N/mm times 3 mm; the shear is that of the law, whatever the coefficient.
    assert state.normal_force_n == pytest.approx(4.5, rel=0.03)
    assert state.shear_force_n[0] == pytest.approx(-0.5 * 4.5, rel=0.03)
    assert parts(state)[0] == pytest.approx(1e3 * ContactLaw().max_shear_m(0.003), rel=0.03)
    away = hand.move((0, 0, -10, 0, 0, 0), 0.5)
    assert not away.in_contact
    assert not away.slipping
    assert away.normal_force_n == 0.0
    np.testing.assert_allclose(parts(away), [0, 0, -2, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("depth_mm", [0.5, 1.0, 2.0, 3.0, 4.5, 6.0])
def test_what_survives_a_slide_is_within_a_tenth_of_the_law_that_was_fitted_to_real_images(depth_mm: float) -> None:
    hand = CommandedTip(FLOOR, ABOVE)
    hand.move((0, 0, 10, 0, 0, 0), 0.1 * (depth_mm + 0.5))
    hand.move((20, 0, 0, 0, 0, 0), 0.7)
    state = hand.move((2, 0, 0, 0, 0, 0), 0.3)
    assert state.slipping
    assert parts(state)[0] == pytest.approx(1e3 * ContactLaw().max_shear_m(1e-3 * depth_mm), rel=0.1)


def test_a_centre_of_mass_aside_turns_a_prism_that_is_pushed_through_its_middle() -> None:
    yaw = {}
    for aside_mm in (-10, 0, 10):
        for physics in ("quasi_static", "dynamic"):
            prism = {**PRISM, "center_of_mass_mm": [0, aside_mm]}
            hand = CommandedTip({"objects": {"prism": prism}}, BEHIND, physics)
            hand.move((0, 0, 20, 0, 0, 0), 2.0)
            T = hand.object()
            yaw[physics, aside_mm] = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    for physics in ("quasi_static", "dynamic"):
        assert abs(yaw[physics, 0]) < 0.5
        assert yaw[physics, 10] == pytest.approx(-yaw[physics, -10], rel=0.1)
        # The heavy side stays behind.
        assert yaw[physics, 10] > 3.0
    assert yaw["quasi_static", 10] == pytest.approx(yaw["dynamic", 10], rel=0.3)


@pytest.mark.parametrize(("tilt_deg", "slides"), [(14.0, False), (20.0, True)])
def test_an_object_slides_down_a_table_that_is_steeper_than_its_friction(tilt_deg: float, slides: bool) -> None:
    scene = {"objects": {"prism": PRISM}, "table": {"friction": 0.3, "tilt_deg": [0, tilt_deg]}}
    # The tip stands far away.
    hand = CommandedTip(scene, (-300, 0, 30, 0, 90, 0))
    hand.move(STILL, 0.5)
    # MuJoCo's friction creeps by some micrometres.
    assert (1e3 * hand.object()[0, 3] > 1.0) == slides


def test_quasi_static_physics_refuse_a_slope_on_which_nothing_rests() -> None:
    table = {"friction": 0.3, "tilt_deg": [0, 20]}
    with pytest.raises(ValidationError, match="steeper than friction"):
        SceneConfig.model_validate({"physics": "quasi_static", "objects": {"prism": PRISM}, "table": table})


@pytest.mark.parametrize("physics", ["quasi_static", "dynamic"])
def test_an_object_is_harder_to_push_on_a_rough_patch(physics: str) -> None:
    depth_mm = []
    for factor in (1.0, 2.0):
        table = {"friction": "mdf", "patches": [{"center_mm": [0, 0], "radius_mm": 300, "factor": factor}]}
        hand = CommandedTip({"objects": {"prism": PRISM}, "table": table}, BEHIND, physics)
        depth_mm.append(1e3 * hand.move((0, 0, 20, 0, 0, 0), 1.0).depth_m)
    assert depth_mm[1] == pytest.approx(2.0 * depth_mm[0], rel=0.05)


@pytest.mark.parametrize("kind", ["dome", "ramp"])
def test_a_tip_slides_over_curved_surfaces(kind: str) -> None:
    shape = {"kind": "dome", "radius_mm": 60} if kind == "dome" else {"kind": "ramp", "bend_radius_mm": 80}
    if kind == "ramp":
        shape["incline_deg"] = 30
    z_mm = 80 if kind == "dome" else 20
    poses = []
    for physics in ("kinematic", "dynamic"):
        hand = CommandedTip({"surfaces": {"it": shape}}, (0, 0, z_mm - 3, 180, 0, 0), physics)
        hand.move(STILL, 0.2)
        poses.append(parts(hand.move((20, 0, 0, 0, 0, 0), 0.9)))
    law, physics = poses
    np.testing.assert_allclose(physics[2:5], law[2:5], atol=1e-6)
    # Both slide; how much shear survives differs by their friction laws.
    assert np.sign(physics[0]) == np.sign(law[0])


def test_a_turning_plate_drags_the_tip_along() -> None:
    plate = {
        "kind": "plane",
        "motion": {"kind": "glide", "displacement_mm_deg": [0, 0, 0, 0, 0, 4], "start_s": 0.2, "duration_s": 1.0},
    }
    hand = CommandedTip({"surfaces": {"plate": plate}}, (10, 0, 16, 180, 0, 0))
    state = hand.move(STILL, 1.6)
    x, y, z, *_, gamma = parts(state)
    # {f} looks down: what turns by +4 deg about the world's z leaves the sensor turned by +4 deg about {f}'s.
    assert gamma == pytest.approx(4.0, abs=0.15)
    assert z == pytest.approx(4.0)
    assert np.hypot(x, y) == pytest.approx(2 * 10 * np.sin(np.radians(2.0)), abs=0.08)


def test_a_pushed_prism_resists_with_the_friction_of_its_weight() -> None:
    hand = CommandedTip({"objects": {"prism": PRISM}}, BEHIND)
    hand.move((0, 0, 20, 0, 0, 0), 1.0)
    forces = [hand.move((0, 0, 20, 0, 0, 0), 0.02).normal_force_n for _ in range(50)]
    assert np.mean(forces) == pytest.approx(0.3 * 0.479 * GRAVITY_M_S2, rel=0.03)
    assert hand.object()[0, 3] > 0.035
    np.testing.assert_allclose(hand.object()[1:3, 3], 0.0, atol=1e-4)


@pytest.mark.parametrize("width_mm", [(80, 80), (80, 140)])
def test_an_off_centre_push_rotates_as_uniform_pressure_predicts(width_mm: tuple[int, int]) -> None:
    block = {"shape": {"kind": "box", "size_mm": [*width_mm, 60]}, "mass_g": 400}
    # A small tip that does not slip is a point that pushes: 10 mm beside the middle.
    point = {"radius_mm": 2, "friction": 1.5}
    hand = CommandedTip({"objects": {"block": block}, "tip": point}, (-42.2, 10, 30, 0, 90, 0))
    # It gives way by 0.7 mm.
    hand.move((0, 0, 20, 0, 0, 0), 3.045)
    T = hand.object()
    yaw = np.arctan2(T[1, 0], T[0, 0])
    expected = uniform_pressure_yaw(1e-3 * np.array(width_mm), np.array([-0.042, 0.010]), 0.060)
    assert yaw == pytest.approx(expected, rel=0.1)


def test_a_tall_prism_pushed_high_falls_and_pushed_low_does_not() -> None:
    leans = {}
    for z_mm in (50, 140):
        tall = {"shape": {"kind": "box", "size_mm": [60, 60, 200]}, "mass_g": 500}
        hand = CommandedTip({"objects": {"tall": tall}, "table": {"friction": 0.5}}, (-51, 0, z_mm, 0, 90, 0))
        hand.move((0, 0, 30, 0, 0, 0), 2.0)
        leans[z_mm] = np.degrees(np.arccos(min(hand.object()[2, 2], 1.0)))
    assert leans[50] < 1.0
    assert leans[140] > 60.0


def test_two_tips_carry_a_prism_off_the_table() -> None:
    hand = CommandedTip({"objects": {"prism": PRISM}}, BEHIND)
    hand.poses["other"] = se3.from_euler_mm_deg(np.array([60.5, 0, 30, 0, -90, 0], dtype=float))
    hand.scene.mount("other", lambda: hand.poses["other"])
    hand.move_all({"tip": (0, 0, 10, 0, 0, 0), "other": (0, 0, 10, 0, 0, 0)}, 0.65)
    # The tips have their x axes along the world's -z and z.
    hand.move_all({"tip": (-20, 0, 0, 0, 0, 0), "other": (20, 0, 0, 0, 0, 0)}, 1.0)
    hand.move(STILL, 0.5)
    weight_n = 0.479 * GRAVITY_M_S2
    shear_n_mm = 1e-3 * ContactLaw().shear_stiffness_n_m(0.006)
    assert 1e3 * hand.object()[2, 3] == pytest.approx(20.0 - 0.5 * weight_n / shear_n_mm, abs=0.3)
    for name in ("tip", "other"):
        state = hand.scene.contact(name).value
        assert state.depth_m == pytest.approx(0.006, abs=1e-4)
        # Half of the weight pulls each tip down by its shear stiffness at that depth.
        assert abs(parts(state)[0]) == pytest.approx(0.5 * weight_n / shear_n_mm, abs=0.05)


def test_a_sticking_contact_does_not_creep() -> None:
    hand = CommandedTip(FLOOR, ABOVE)
    hand.move((0, 0, 10, 0, 0, 0), 0.45)
    hand.move((10, 0, 0, 0, 0, 0), 0.4)
    before = parts(hand.move(STILL, 0.3))
    after = parts(hand.move(STILL, 2.0))
    assert before[0] == pytest.approx(4.0, abs=0.05)
    assert abs(after[0] - before[0]) / 2.0 <= 0.010


def test_a_millisecond_is_fine_enough() -> None:
    script = [((0, 0, 10, 0, 0, 0), 0.45), (STILL, 0.1), ((10, 0, 0, 0, 0, 0), 0.4), ((0, 0, 0, 0, 0, 10), 0.3)]
    script += [((0, 0, 0, 20, 0, 0), 0.4), ((0, -20, 0, 0, 0, 0), 0.4), (STILL, 0.2)]
    felt = []
    for step_ms in (1.0, 0.1):
        hand = CommandedTip({**FLOOR, "physics_step_ms": step_ms}, ABOVE)
        felt.append(np.array([parts(hand.move(twist, s / 4)) for twist, s in script for _ in range(4)]))
    np.testing.assert_allclose(felt[0][:, :2], felt[1][:, :2], atol=0.1)


@pytest.mark.parametrize("physics", ["kinematic", "dynamic"])
def test_a_snapshot_brings_back_the_very_same_future(physics: str) -> None:
    plate = {"kind": "plane", "motion": {"kind": "periodic", "amplitude_mm_deg": [30, 20, 1, 2, 2, 3], "period_s": 2}}
    scene = {"surfaces": {"plate": plate}}
    if physics == "dynamic":
        scene["objects"] = {"prism": PRISM | {"pose_mm_deg": [200, 0, 0, 0, 0, 0]}}
    hand = CommandedTip(scene, ABOVE, physics)
    hand.move((0, 5, 10, 0, 0, 0), 0.3)
    restore, pose = hand.scene.snapshot(), hand.poses["tip"].copy()
    before = hand.scene.contact("tip", hand.clock.now_ns() - 100_000_000).value
    futures = []
    for _ in range(3):
        states = [hand.move((10, 0, 1, 0, 3, 0), 0.05) for _ in range(6)]
        futures.append(np.array([[s.T_f_s, s.T_world_f] for s in states]))
        restore()
        hand.poses["tip"] = pose
        after = hand.scene.contact("tip", hand.clock.now_ns() - 100_000_000).value
        np.testing.assert_array_equal(after.T_f_s, before.T_f_s)
        np.testing.assert_array_equal(after.T_world_f, before.T_world_f)
        assert (after.in_contact, after.normal_force_n) == (before.in_contact, before.normal_force_n)
    assert futures[0][-1, 0, 2, 3] > 0.002
    for future in futures[1:]:
        np.testing.assert_array_equal(future, futures[0])
    hand.scene.mount("late", lambda: pose)
    with pytest.raises(ConfigError, match="mounted after"):
        restore()


def test_non_finite_numbers_raise_an_error() -> None:
    from touchcell.simulation.dynamics import PhysicsError

    hand = CommandedTip(FLOOR, ABOVE)
    hand.move(STILL, 0.01)
    hand.poses["tip"] = np.full((4, 4), np.nan)
    with pytest.raises(PhysicsError, match="pose of 'tip' is not finite") as error:
        hand.move(STILL, 0.002)
    assert error.value.t_s == pytest.approx(0.010)


def test_dynamic_physics_names_the_missing_package(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="not a multiple of physics_step_ms"):
        SceneConfig.model_validate({"physics": "dynamic", **FLOOR, "step_ms": 0.5})
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in ("touchcell.simulation.dynamics", "touchcell.simulation.dynamics_model"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ConfigError, match="needs mujoco, which is not installed") as error:
        SceneConfig.model_validate({"physics": "dynamic", **FLOOR}).build(VirtualClock())
    assert "touchcell[physics]" in str(error.value)
