import sys

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.clock import VirtualClock
from drivers.errors import ConfigError
from drivers.simulation.contact import ContactState
from drivers.simulation.scene import Scene, SceneConfig
from geometry import se3

mujoco = pytest.importorskip("mujoco")

SI = np.array([1e-3] * 3 + [np.pi / 180.0] * 3)
GRAVITY = 9.81
STILL = (0, 0, 0, 0, 0, 0)


class Hand:
    """Moves one sensor through a scene by twists in its own frame, mm/s and deg/s."""

    def __init__(self, scene: dict, start_mm_deg: tuple[float, ...], physics: str = "dynamic", name: str = "tip"):
        self.clock = VirtualClock()
        self.scene: Scene = SceneConfig.model_validate({"physics": physics, **scene}).build(self.clock)
        self.poses = {name: se3.from_euler_mm_deg(np.array(start_mm_deg, dtype=float))}
        self.scene.mount(name, lambda: self.poses[name])
        self.name = name

    def move(self, twist_mm_deg: tuple[float, ...], seconds: float) -> ContactState:
        step_s = self.scene.timeline.step_ns * 1e-9
        motion = se3.exp(np.array(twist_mm_deg) * SI * step_s)
        for _ in range(round(seconds / step_s)):
            self.poses[self.name] = self.poses[self.name] @ motion
            self.clock.advance_s(step_s)
            self.scene.timeline.advance()
        return self.scene.contact(self.name).value

    def object(self) -> np.ndarray:
        return next(iter(self.scene.objects().value.values()))


def parts(state: ContactState) -> np.ndarray:
    return se3.to_euler_mm_deg(state.T_f_s)


FLOOR = {"surfaces": {"floor": {"kind": "plane"}}}
ABOVE = (0, 0, 20.5, 180, 0, 0)
PRISM = {"shape": {"kind": "box", "size_mm": [80, 80, 60]}, "mass_g": 479}
# The tip looks along +x at the prism's face, 0.5 mm before it.
BEHIND = (-60.5, 0, 30, 0, 90, 0)


def test_what_sticks_is_felt_as_in_the_kinematic_scene() -> None:
    script = [((0, 0, 10, 0, 0, 0), 0.45), ((4, 0, 0, 0, 0, 0), 0.4), ((0, 0, 0, 0, 0, 5), 0.5)]
    script += [((0, 0, 0, 20, 0, 0), 0.4), ((0, -5, 0, 0, 0, 0), 0.2), (STILL, 0.2)]
    hands = [Hand(FLOOR, ABOVE, physics) for physics in ("kinematic", "dynamic")]
    for twist, seconds in script:
        law, physics = (hand.move(twist, seconds) for hand in hands)
        assert law.in_contact
        assert physics.in_contact
        np.testing.assert_allclose(parts(physics), parts(law), atol=0.06)
        np.testing.assert_allclose(physics.T_world_f, law.T_world_f, atol=1e-3)
        assert not physics.slipping


def test_what_slides_keeps_the_shear_that_friction_holds() -> None:
    hand = Hand({**FLOOR, "tip": {"friction": 0.5}}, ABOVE)
    hand.move((0, 0, 10, 0, 0, 0), 0.35)
    assert hand.move((20, 0, 0, 0, 0, 0), 0.5).slipping
    state = hand.move((2, 0, 0, 0, 0, 0), 0.3)
    assert state.slipping
    # 1.5 N/mm times 3 mm, and half of that against 1 N/mm.
    assert state.normal_force_n == pytest.approx(4.5, rel=0.03)
    assert parts(state)[0] == pytest.approx(0.5 * 4.5, rel=0.03)
    away = hand.move((0, 0, -10, 0, 0, 0), 0.5)
    assert not away.in_contact
    assert not away.slipping
    assert away.normal_force_n == 0.0
    np.testing.assert_allclose(parts(away), [0, 0, -2, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("kind", ["dome", "ramp"])
def test_a_tip_slides_over_what_is_not_flat(kind: str) -> None:
    shape = {"kind": "dome", "radius_mm": 60} if kind == "dome" else {"kind": "ramp", "bend_radius_mm": 80}
    if kind == "ramp":
        shape["incline_deg"] = 30
    z_mm = 80 if kind == "dome" else 20
    poses = []
    for physics in ("kinematic", "dynamic"):
        hand = Hand({"surfaces": {"it": shape}}, (0, 0, z_mm - 3, 180, 0, 0), physics)
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
    hand = Hand({"surfaces": {"plate": plate}}, (10, 0, 16, 180, 0, 0))
    state = hand.move(STILL, 1.6)
    x, y, z, *_, gamma = parts(state)
    # {f} looks down: what turns by +4 deg about the world's z leaves the sensor turned by +4 deg about {f}'s.
    assert gamma == pytest.approx(4.0, abs=0.15)
    assert z == pytest.approx(4.0)
    assert np.hypot(x, y) == pytest.approx(2 * 10 * np.sin(np.radians(2.0)), abs=0.08)


def test_a_pushed_prism_resists_with_the_friction_of_its_weight() -> None:
    hand = Hand({"objects": {"prism": PRISM}}, BEHIND)
    hand.move((0, 0, 20, 0, 0, 0), 1.0)
    forces = [hand.move((0, 0, 20, 0, 0, 0), 0.02).normal_force_n for _ in range(50)]
    assert np.mean(forces) == pytest.approx(0.3 * 0.479 * GRAVITY, rel=0.03)
    assert hand.object()[0, 3] > 0.035
    np.testing.assert_allclose(hand.object()[1:3, 3], 0.0, atol=1e-4)


def test_physics_asks_for_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ValidationError, match="no multiple of physics_step_ms"):
        SceneConfig.model_validate({"physics": "dynamic", **FLOOR, "step_ms": 0.5})
    monkeypatch.setitem(sys.modules, "mujoco", None)
    for name in ("drivers.simulation.dynamics", "drivers.simulation.dynamics_model"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    with pytest.raises(ConfigError, match="mujoco, which is not installed") as error:
        SceneConfig.model_validate({"physics": "dynamic", **FLOOR}).build(VirtualClock())
    assert "touchcell[physics]" in str(error.value)
