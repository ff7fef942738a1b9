import numpy as np
import pytest
from pydantic import ValidationError

from touchcell.drivers.core.clock import VirtualClock
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.simulation.contact import ContactLaw
from touchcell.simulation.motions import Glide
from touchcell.simulation.scene import ContactNotKept, Scene, SceneConfig
from touchcell.simulation.surfaces import Plane, Sphere, Surface
from touchcell.simulation.timeline import Phase, Timeline
from touchcell.simulation.world import KinematicWorld

DOWN = se3.from_euler_mm_deg([0, 0, 0, 180, 0, 0])


def above(z_mm: float, x_mm: float = 0.0) -> np.ndarray:
    return se3.from_euler_mm_deg([x_mm, 0, z_mm, 180, 0, 0])


def test_a_timeline_steps_on_its_grid_in_order_of_phase() -> None:
    clock = VirtualClock(5_000_000)
    timeline = Timeline(clock, 0.002)
    seen: list[tuple[str, int]] = []
    timeline.add(Phase.CONTACT, lambda t_ns: seen.append(("contact", t_ns)))
    timeline.add(Phase.MOTION, lambda t_ns: seen.append(("motion", t_ns)))
    clock.advance_s(0.0045)
    assert timeline.advance() == 8_000_000
    assert timeline.advance() == 8_000_000
    assert seen == [("motion", 6_000_000), ("contact", 6_000_000), ("motion", 8_000_000), ("contact", 8_000_000)]


def test_asking_for_the_time_within_a_step_changes_nothing() -> None:
    clock = VirtualClock()
    timeline = Timeline(clock, 0.002)
    inner: list[int] = []
    timeline.add(Phase.MOTION, lambda t_ns: inner.append(timeline.advance()))
    clock.advance_s(0.006)
    timeline.advance()
    assert inner == [2_000_000, 4_000_000, 6_000_000]


def sliding_scene(clock: VirtualClock) -> Scene:
    plate = Surface(Plane(), Glide(np.eye(4), np.array([0.05, 0, 0, 0, 0, 0.0]), start_s=0.0, duration_s=1.0))
    scene = Scene(KinematicWorld({"plate": plate}, ContactLaw()), clock)
    scene.mount("tip", lambda: above(20.0 - 3.0))
    return scene


def test_contacts_do_not_depend_on_how_often_they_are_read() -> None:
    results = []
    for reads in (1, 10, 137):
        clock = VirtualClock()
        scene = sliding_scene(clock)
        for _ in range(reads):
            clock.sleep_until_ns(clock.now_ns() + 600_000_000 // reads)
            scene.contact("tip")
        clock.sleep_until_ns(600_000_000)
        results.append(scene.contact("tip"))
    for other in results[1:]:
        np.testing.assert_array_equal(results[0].value.T_f_s, other.value.T_f_s)
        assert results[0].t_ns == other.t_ns == 600_000_000
    assert results[0].value.slipping
    # {f} looks down: its y axis is turned, its x axis is the plate's.
    assert results[0].value.T_f_s[0, 3] == pytest.approx(-ContactLaw().max_shear_m(0.003))


def test_the_past_can_be_read_but_not_the_future() -> None:
    clock = VirtualClock()
    scene = sliding_scene(clock)
    clock.advance_s(0.2)
    then = scene.contact("tip").value
    clock.advance_s(0.3)
    assert scene.contact("tip", 200_000_000).value is then
    assert scene.contact("tip", 201_999_999).value is then
    with pytest.raises(ContactNotKept):
        scene.contact("tip", 502_000_000)
    clock.advance_s(5.0)
    with pytest.raises(ContactNotKept):
        scene.contact("tip", 200_000_000)


def test_the_nearest_surface_is_felt() -> None:
    clock = VirtualClock()
    ball = Surface(Sphere(0.03))
    x_mm = [0.0]
    scene = Scene(KinematicWorld({"floor": Surface(Plane()), "ball": ball}, ContactLaw()), clock)
    scene.mount("tip", lambda: above(20.0 - 1.0 if x_mm[0] else 30 + 20 - 2.0, x_mm[0]))
    assert scene.contact("tip").value.depth_m == pytest.approx(0.002)
    x_mm[0] = 200.0
    clock.advance_s(0.002)
    assert scene.contact("tip").value.depth_m == pytest.approx(0.001)


def test_mounting_mistakes_are_named() -> None:
    clock = VirtualClock()
    scene = sliding_scene(clock)
    with pytest.raises(ConfigError, match="mounted already"):
        scene.mount("tip", lambda: DOWN)
    with pytest.raises(ConfigError, match="no sensor 'palm'"):
        scene.contact("palm")
    with pytest.raises(ConfigError, match="no surface"):
        KinematicWorld({}, ContactLaw())


def test_a_scene_is_built_from_its_configuration() -> None:
    config = SceneConfig.model_validate(
        {
            "step_ms": 1.0,
            "tip": {"radius_mm": 15.0},
            "surfaces": {
                "table": {"kind": "plane"},
                "bump": {"kind": "dome", "radius_mm": 40.0, "pose_mm_deg": [300, 0, 0, 0, 0, 0]},
                "ball": {"kind": "sphere", "radius_mm": 25.0, "pose_mm_deg": [600, 0, 100, 0, 0, 0]},
                "ramp": {
                    "kind": "ramp",
                    "bend_radius_mm": 80.0,
                    "incline_deg": 30.0,
                    "pose_mm_deg": [0, 0, -900, 0, 0, 0],
                },
                "plate": {
                    "kind": "plane",
                    "pose_mm_deg": [0, 0, -500, 0, 0, 0],
                    "motion": {
                        "kind": "glide",
                        "displacement_mm_deg": [0, 0, 100, 0, 0, 0],
                        "start_s": 0.5,
                        "duration_s": 2.0,
                    },
                },
                "orbit": {
                    "kind": "plane",
                    "motion": {"kind": "periodic", "amplitude_mm_deg": [75, 75, 10, 5, 5, 10], "period_s": 6.0},
                },
            },
        }
    )
    clock = VirtualClock(7_000_000_000)
    scene = config.build(clock)
    assert scene.timeline.step_ns == 1_000_000
    world = scene.world
    assert isinstance(world, KinematicWorld)
    assert world.law.tip_radius_m == 0.015
    far = np.array([0.3, 0.0, 0.3])
    assert world.surfaces["bump"].nearest(far, 0.0).distance_m == pytest.approx(0.26)
    assert world.surfaces["ball"].nearest(np.array([0.6, 0, 0.2]), 0.0).distance_m == pytest.approx(0.075)
    assert world.surfaces["plate"].nearest(far, 9.0).distance_m == pytest.approx(0.7)
    assert world.surfaces["plate"].nearest(far, 0.0).distance_m == pytest.approx(0.8)
    assert scene.seconds(7_500_000_000) == pytest.approx(0.5)
    np.testing.assert_array_equal(world.surfaces["orbit"].motion.pose(0.0), np.eye(4))


@pytest.mark.parametrize(
    "config",
    [
        {"surfaces": {}},
        {"surfaces": {"a": {"kind": "cube"}}},
        {"surfaces": {"a": {"kind": "sphere"}}},
        {"surfaces": {"a": {"kind": "sphere", "radius_mm": -1}}},
        {"surfaces": {"a": {"kind": "sphere", "radius_m": 0.1}}},
        {"surfaces": {"a": {"kind": "plane", "pose_mm_deg": [0, 0, float("nan"), 0, 0, 0]}}},
        {"surfaces": {"a": {"kind": "plane"}}, "gravity": 9.8},
        {"surfaces": {"a": {"kind": "plane"}}, "step_ms": 0},
        {
            "surfaces": {
                "a": {
                    "kind": "plane",
                    "motion": {
                        "kind": "glide",
                        "displacement_mm_deg": [0, 0, 0, 10, 10, 0],
                        "start_s": 0,
                        "duration_s": 1,
                    },
                }
            }
        },
    ],
    ids=str,
)
def test_senseless_scenes_are_refused(config: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        SceneConfig.model_validate(config)


def test_free_objects_are_refused_where_nothing_moves_them() -> None:
    prism = {"shape": {"kind": "box", "size_mm": [80, 80, 60]}, "mass_g": 479}
    with pytest.raises(ValidationError, match="need physics other than kinematic"):
        SceneConfig.model_validate({"objects": {"prism": prism}})
    with pytest.raises(ValidationError, match="neither surfaces nor objects"):
        SceneConfig.model_validate({})
