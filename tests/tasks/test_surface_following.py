"""Surface following, and the state machine that it shares with object tracking, on exact kinematics and simulated."""

from __future__ import annotations

from itertools import count
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.helpers.kinematic_plant import CONTEXT, DT, RATE_HZ, KinematicPlant
from tests.helpers.simulated_loop import SimulatedLoop
from touchcell.control.resting_depth import ReadDepth
from touchcell.geometry import se3
from touchcell.tasks.interface import Task
from touchcell.tasks.servoing import servo_table
from touchcell.tasks.state_machine import state_name
from touchcell.tasks.surface_following import SPEC, Follow, SurfaceFollowingConfig

QUICK = SurfaceFollowingConfig(distance_mm=20.0, approach_distance_mm=20.0, retract_mm=5.0, settle_time_s=0.1)
ACTIVE = ("prepare", "approach", "check", "settle", "run", "return", "retract")
ON_SURFACE = ("approach", "settle", "run")


def build(config: SurfaceFollowingConfig = QUICK) -> Task:
    return SPEC.build(config, CONTEXT)


def path(task: Task) -> list[tuple[str, str, str]]:
    return [(r.source, r.event, r.target) for r in task.transitions]


WHOLE = [
    ("prepare", "ready", "approach"),
    ("approach", "contact", "check"),
    ("check", "agrees", "settle"),
    ("settle", "settled", "run"),
    ("run", "finished", "retract"),
    ("retract", "retracted", "done"),
]


def test_follows_a_plane_from_start_to_end():
    plant, task = KinematicPlant(), build(QUICK.model_copy(update={"distance_mm": 60.0}))
    plant.run(task, until="run")
    start = plant.T_w_s[:3, 3]
    actions = plant.run(task, until="retract")
    assert len(actions) == pytest.approx(60.0 / 20.0 * RATE_HZ, abs=8)  # slower while a tilt is corrected
    labels = se3.to_euler_mm_deg(plant.seen)
    np.testing.assert_allclose(labels[2:5], [3.0, 0.0, 0.0], atol=0.001)
    assert np.linalg.norm(plant.T_w_s[:3, 3] - start) == pytest.approx(0.060, abs=0.0005)
    at_end = plant.T_w_s
    plant.run(task)
    assert path(task) == WHOLE
    assert task.succeeded
    back = se3.compose(se3.inverse(at_end), plant.T_w_s)[:3, 3]
    np.testing.assert_allclose(back, [0, 0, -0.005], atol=0.0006)


def test_pressing_in_overshoots_little():
    plant, task = KinematicPlant(tilt_deg=(0.0, 0.0)), build()
    deepest = 0.0
    while not task.finished:
        plant.cycle(task)
        deepest = max(deepest, plant.seen[2, 3])
    assert 0.003 < deepest < 0.00325


@pytest.mark.parametrize("direction_deg", [0.0, 90.0, 135.0, -60.0])
def test_direction_is_counted_from_the_sensors_x_axis(direction_deg):
    plant, task = KinematicPlant(tilt_deg=(0.0, 0.0)), build(QUICK.model_copy(update={"direction_deg": direction_deg}))
    plant.run(task, until="run")
    start = plant.T_w_s
    plant.run(task, until="retract")
    moved = se3.compose(se3.inverse(start), plant.T_w_s)[:3, 3]
    assert np.degrees(np.arctan2(moved[1], moved[0])) == pytest.approx(direction_deg, abs=0.1)


def test_commands_carry_time_cause_and_time_to_live():
    plant, task = KinematicPlant(), build()
    for action in plant.run(task):
        for command in action.twists.values():
            assert command.ttl_s == pytest.approx(3 * DT)
            assert command.t_cause_ns == command.t_ns
    assert {"frame_age_ms", "error_z_mm", "error_alpha_deg"} <= set(plant_telemetry())


def plant_telemetry():
    plant, task = KinematicPlant(), build()
    plant.run(task, until="run")
    return plant.cycle(task).telemetry


@pytest.mark.parametrize("state", ON_SURFACE)
@pytest.mark.parametrize("loss", ["frames", "states"])
def test_stale_data_stops_the_arm_and_then_trips(state, loss):
    plant, task = KinematicPlant(), build()
    plant.run(task, until=state)
    plant.cycle(task)
    setattr(plant, loss, False)
    limit_ms = QUICK.max_frame_age_ms if loss == "frames" else QUICK.max_state_age_ms
    moving = 0
    while not task.finished:
        moving += bool(plant.cycle(task).twists)
    assert moving <= limit_ms * 1e-3 * RATE_HZ
    assert task.state == "tripped"
    assert f"{QUICK.stale_timeout_s:.1f}" in task.transitions[-1].reason


@pytest.mark.parametrize("state", ["settle", "run"])
def test_an_estimate_out_of_range_moves_nothing_and_is_tolerated_if_short(state):
    plant, task = KinematicPlant(), build()
    plant.run(task, until=state)
    plant.cycle(task)
    plant.in_range = False
    for _ in range(20):
        assert not plant.cycle(task).twists
    plant.in_range = True
    plant.run(task)
    assert task.succeeded


def test_a_lost_contact_is_searched_for_a_limited_number_of_times():
    plant, task = KinematicPlant(), build()
    for _ in range(QUICK.max_reapproach + 1):
        plant.touching = True
        plant.run(task, until="run")
        plant.touching = False
        plant.cycle(task)
    plant.run(task)
    assert task.state == "failed"
    assert path(task).count(("run", "lost", "return")) == QUICK.max_reapproach
    assert path(task)[-2:] == [("run", "lost", "retract"), ("retract", "retracted", "failed")]


def test_a_lost_contact_is_searched_for_where_it_was_last_felt():
    plant, task = KinematicPlant(tilt_deg=(0.0, 0.0)), build()
    plant.run(task, until="run")
    for _ in range(20):
        plant.cycle(task)
    felt = plant.T_w_s
    plant.touching = False
    plant.run(task, until="approach")
    back = se3.compose(se3.inverse(felt), plant.T_w_s)
    np.testing.assert_allclose(back[:3, 3], [0.0, 0.0, -0.003], atol=0.0015)
    plant.touching = True
    plant.run(task)
    assert task.succeeded


@pytest.mark.parametrize(
    "section",
    [
        {"kind": "raster", "size_mm": [20, 10], "spacing_mm": 5},
        {"kind": "spiral", "radius_mm": 12, "spacing_mm": 4},
        {"kind": "through", "points_mm": [[20, 0], [20, 15], [0, 15]]},
    ],
)
def test_a_planned_path_is_followed_to_its_end(section):
    config = SurfaceFollowingConfig.model_validate({**QUICK.model_dump(), "path": section})
    plant, task = KinematicPlant(tilt_deg=(0.0, 0.0)), build(config)
    plant.run(task, until="run")
    start, places = plant.T_w_s, []
    while task.state == "run":
        plant.cycle(task)
        places.append(se3.compose(se3.inverse(start), plant.T_w_s)[:2, 3])
    plant.run(task)
    assert task.succeeded
    for x, y in config.path.points():
        assert min(np.hypot(*(np.array([x, y]) - place)) for place in places) < 0.0025


def test_points_of_a_path_must_differ():
    with pytest.raises(ValidationError, match="twice"):
        SurfaceFollowingConfig.model_validate({"path": {"kind": "through", "points_mm": [[1, 0], [1, 0]]}})


def reached(state: str) -> tuple[KinematicPlant, Task]:
    """Return a plant and a task that has just entered ``state``."""
    config = QUICK.model_copy(update={"settle_timeout_s": 0.5, "max_reapproach": 1})
    plant, task = KinematicPlant(), build(config)
    if state == "return":
        plant.run(task, until="run")
        plant.touching = False
    plant.run(task, until=state)
    plant.touching = True
    return plant, task


def expected_rows() -> set[tuple[str, str, str]]:
    table = servo_table("x", QUICK, 1.0)
    rows, settled = set(), set()
    for row in table.transitions:
        for source in table.sources(row):
            if (source, row.event) not in settled:
                rows.add((state_name(source), row.event, state_name(row.target)))
                if row.guard is None:
                    settled.add((source, row.event))
    return rows


def every_way() -> set[tuple[str, str, str]]:
    seen: set[tuple[str, str, str]] = set()

    def finish(plant: KinematicPlant, task: Task) -> None:
        plant.run(task)
        seen.update(path(task))

    finish(KinematicPlant(gap_mm=-1.0), build())
    for state in ACTIVE:
        plant, task = reached(state)
        finish(plant, task)
        plant, task = reached(state)
        task.trip(plant.now_ns, "test")
        finish(plant, task)
        plant, task = reached(state)
        plant.broken = True
        finish(plant, task)
        plant, task = reached(state)
        plant.operator_stop = True
        finish(plant, task)
        plant, task = reached(state)
        plant.frozen = True
        plant.frames = state != "prepare"
        finish(plant, task)
        if state in ("check", "settle", "run"):
            plant, task = reached(state)
            for _ in range(2):
                plant.touching = False
                plant.run(task, until="approach")
                plant.touching = True
                plant.run(task, until=state)
            finish(plant, task)
    plant, task = reached("check")
    for cycle in count():
        # Each estimate comes before the arm trips for lack of one, and the motion takes too long.
        plant.in_range = cycle % 40 == 39
        plant.cycle(task)
        if task.state != "check":
            break
    finish(plant, task)
    plant, task = KinematicPlant(), build(QUICK.model_copy(update={"return_lift_mm": None}))
    plant.run(task, until="run")
    plant.touching = False
    plant.run(task, until="approach")
    plant.touching = True
    finish(plant, task)
    plant, task = KinematicPlant(gap_mm=25.0), build()
    finish(plant, task)
    with patch.object(Follow, "shortfall", return_value="5 mm from the target"):
        plant, task = reached("run")
        finish(plant, task)
    assert task.transitions[-2].reason == "5 mm from the target"
    assert not task.succeeded
    return seen


def test_it_takes_a_zero_frame_before_and_after_it_backs_off() -> None:
    plant, task = KinematicPlant(gap_mm=3.0), build()
    plant.image = 0.3
    start = plant.T_w_s
    plant.run(task, until="approach")
    assert plant.zeros == 2
    back = se3.compose(se3.inverse(start), plant.T_w_s)[:3, 3]
    np.testing.assert_allclose(back, [0, 0, -0.002], atol=3e-4)
    plant.run(task, until="settle")
    assert 0.0005 < plant.seen[2, 3] < 0.0015


@pytest.mark.parametrize("image", [None, 0.3])
def test_it_refuses_by_name_to_start_in_contact(image) -> None:
    plant, task = KinematicPlant(gap_mm=-1.0), build()
    plant.image = image
    plant.run(task)
    assert path(task) == [("prepare", "touching", "failed")]
    assert "sensor is in contact before the approach" in task.transitions[-1].reason


def test_an_image_that_changes_without_touch_and_then_stays_trips() -> None:
    plant, task = KinematicPlant(gap_mm=15.0), build()
    plant.image = 0.0
    plant.run(task, until="approach")
    plant.knocked = 0.2
    plant.run(task)
    assert path(task)[-1] == ("approach", "trip", "tripped")
    assert "does not change while the arm moves" in task.transitions[-1].reason
    assert plant.seen[2, 3] < -0.005


def test_a_light_object_that_is_carried_along_is_told_from_a_phantom_by_letting_go_of_it() -> None:
    plant, task = KinematicPlant(gap_mm=5.0), build()
    plant.image, plant.gives_way_mm = 0.0, 0.45
    plant.run(task, until="settle")
    assert task.state == "settle"
    assert 0.4e-3 < plant.seen[2, 3] < 0.5e-3
    carried_mm = 1e3 * float((plant.T_w_f[:3, 3] - KinematicPlant(gap_mm=5.0).T_w_f[:3, 3]) @ plant.T_w_f[:3, 2])
    assert 2.0 < carried_mm < 3.5


def test_every_transition_can_be_made_and_no_other():
    assert every_way() == expected_rows()


@pytest.mark.parametrize("state", ACTIVE)
def test_a_stop_ends_at_rest_in_the_stopped_state(state):
    plant, task = reached(state)
    plant.operator_stop = True
    plant.run(task)
    assert task.state == "stopped"
    assert not task.succeeded
    assert plant.cycle(task).twists == {}


@pytest.mark.parametrize("state", ACTIVE)
def test_nothing_moves_after_a_trip(state):
    plant, task = reached(state)
    task.trip(plant.now_ns, "depth")
    assert task.state == "tripped"
    assert task.transitions[-1].reason == "depth"
    for _ in range(20):
        assert plant.cycle(task).twists == {}


def test_a_fault_is_reported_with_its_reason():
    plant, task = reached("run")
    plant.broken = True
    assert plant.cycle(task).twists == {}
    assert task.state == "faulted"
    assert "compose" in task.transitions[-1].reason


SWITCHES = ("frames", "states", "touching", "in_range", "frozen", "broken", "operator_stop")


@settings(max_examples=40)
@given(
    walk=st.lists(
        st.tuples(st.integers(1, 60), st.sampled_from((*SWITCHES, "nothing", "trip")), st.booleans()), max_size=12
    )
)
def test_walks(walk):
    """In any order of events: no motion on stale data, none after a trip, and a stop ends at rest."""
    plant, task = KinematicPlant(), build()
    tripped = False
    stale = {"frames": 0, "states": 0}
    for cycles, switch, value in walk:
        if switch == "trip":
            tripped = tripped or not task.finished
            task.trip(plant.now_ns, "test")
        elif switch != "nothing":
            setattr(plant, switch, value)
        for _ in range(cycles):
            for source in stale:
                stale[source] = 0 if getattr(plant, source) else stale[source] + 1
            was_finished = task.finished
            twists = plant.cycle(task).twists
            if twists:
                assert not tripped
                assert not was_finished
                assert stale["states"] * DT <= QUICK.max_state_age_ms * 1e-3 + DT
                assert task.state == "retract" or stale["frames"] * DT <= QUICK.max_frame_age_ms * 1e-3 + DT
                assert np.isfinite(twists["arm"].twist).all()
    for switch in ("frames", "states", "touching", "in_range", "operator_stop"):
        setattr(plant, switch, True)
    plant.frozen = False
    plant.run(task)
    assert plant.cycle(task).twists == {}
    if tripped:
        assert task.state == "tripped"


def test_distance_is_counted_along_the_direction_of_travel_only():
    follow = Follow(QUICK.model_copy(update={"direction_deg": 90.0}))
    T = se3.from_euler_mm_deg(np.array([10.0, 20.0, 30.0, 0.0, 0.0, 90.0]))

    def go_on(*displacement_mm: float) -> bool:
        moved = T @ se3.from_euler_mm_deg(np.array([*displacement_mm, 0.0, 0.0, 0.0]))
        return follow.update(DT, T, moved, None)

    assert not go_on(1000.0, 0.0, 1000.0)
    assert not go_on(0.0, -10.0, 0.0)
    assert not go_on(0.0, 29.0, 0.0)
    assert go_on(0.0, 2.0, 0.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"depth_mm": 0.0},
        {"speed_mm_s": -1.0},
        {"kp_per_s": (1, 2, 3)},
        {"kp_per_s": (0, 0, float("nan"), 0, 0, 0)},
        {"speed": 20},
        {"retract_mm": 0},
        {"max_reapproach": -1},
    ],
)
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(ValidationError):
        SurfaceFollowingConfig(**wrong)


RAMPS = [
    ({"kind": "ramp", "bend_radius_mm": 100.0, "incline_deg": 30.0}, 0.0),
    ({"kind": "ramp", "bend_radius_mm": 100.0, "incline_deg": -30.0}, 0.0),
]
DOMES = [({"kind": "dome", "radius_mm": 70.0}, direction) for direction in (0.0, 45.0, 180.0, 270.0)]


@pytest.mark.parametrize(("surface", "direction_deg"), RAMPS + DOMES)
def test_follows_ramp_and_dome_in_the_simulator(surface, direction_deg):
    """Limits: depth within 0.1 mm and tilt within 1 deg RMS at 20 mm/s with 30 Hz frames and 100 Hz control."""
    on_ramp = surface["kind"] == "ramp"
    start = (-30.0, 0.0, 40.0, 180.0, 0.0, 0.0) if on_ramp else (0.0, 0.0, 110.0, 180.0, 0.0, 0.0)
    loop = SimulatedLoop(surface, start)
    config = SurfaceFollowingConfig(direction_deg=direction_deg, distance_mm=100.0 if on_ramp else 60.0)
    task = SPEC.build(config, loop.context)
    log = loop.run(task)
    print(
        f"{surface} {direction_deg:g} deg: depth {log.depth_rms_mm(3.0):.3f} mm, tilt {log.tilt_rms_deg():.2f} deg RMS"
    )
    assert task.succeeded
    assert log.depth_rms_mm(3.0) < 0.05
    assert log.tilt_rms_deg() < 0.7
    assert np.isfinite(log.labels()).all()
    turned = np.degrees(np.arccos(-log.truth[-1].T_world_f[2, 2]))
    assert turned == pytest.approx(30.0 if on_ramp else np.degrees(60.0 / 87.0), abs=1.5)


@pytest.mark.parametrize(
    ("surface", "speed_mm_s"),
    [(DOMES[0][0], 60.0), ({"kind": "ramp", "bend_radius_mm": 60.0, "incline_deg": 25.0}, 20.0)],
)
def test_turns_with_a_surface_that_bends(surface, speed_mm_s):
    """By feedforward of its curvature; where it could not turn as fast as it goes, it goes slower.

    Of frames without a filter; without the feedforward the tilt is 5.6 and 17 deg.
    """
    on_ramp = surface["kind"] == "ramp"
    loop = SimulatedLoop(
        surface, (-30.0, 0.0, 40.0, 180.0, 0.0, 0.0) if on_ramp else (0.0, 0.0, 110.0, 180.0, 0.0, 0.0)
    )
    task = SPEC.build(SurfaceFollowingConfig(speed_mm_s=speed_mm_s, distance_mm=80.0), loop.context)
    log = loop.run(task)
    assert task.succeeded
    assert log.depth_rms_mm(3.0) < 0.1
    assert log.tilt_rms_deg() < 1.6


def test_meets_the_limits_under_single_frame_noise():
    noise = np.array([0.25e-3, 0.25e-3, 0.06e-3, *np.radians([0.35, 0.35, 0.8])])
    loop = SimulatedLoop(RAMPS[0][0], (-30.0, 0.0, 40.0, 180.0, 0.0, 0.0), noise=noise, latency_s=0.04, seed=1)
    task = SPEC.build(SurfaceFollowingConfig(), loop.context)
    log = loop.run(task)
    assert task.succeeded
    assert log.depth_rms_mm(3.0) < 0.1
    assert log.tilt_rms_deg() < 1.0


def test_an_operators_stop_withdraws_from_the_dome_and_comes_to_rest():
    loop = SimulatedLoop(DOMES[0][0], (0.0, 0.0, 110.0, 180.0, 0.0, 0.0))
    task = SPEC.build(SurfaceFollowingConfig(), loop.context)
    loop.run(task, stop_when=lambda observation: task.state == "run" and observation.now_ns > 5e9)
    assert task.state == "stopped"
    assert not loop.scene.contact("sensor").value.in_contact
    loop.clock.advance_s(1.0)
    loop.scene.contact("sensor")
    before = loop.arm.T_world_tcp().copy()
    loop.clock.advance_s(1.0)
    loop.scene.contact("sensor")
    np.testing.assert_array_equal(loop.arm.T_world_tcp(), before)


def test_a_model_that_knows_its_depth_is_left_alone_and_one_that_does_not_is_corrected() -> None:
    """The arm's motion tells an error to 0.15 mm."""

    def eased_mm(error_mm: float, sigma_mm: float) -> float:
        depth = ReadDepth()
        depth.correct_depth(1e-3 * error_mm, 1e-3 * sigma_mm)
        return 1e3 * depth.ease_m

    assert eased_mm(-0.1, 0.03) == pytest.approx(0.0, abs=0.02)
    assert eased_mm(-0.2, 0.3) == pytest.approx(0.16, abs=0.01)
    # However sure it is.
    assert eased_mm(-0.5, 0.03) == pytest.approx(0.45, abs=0.02)
    assert eased_mm(0.5, 0.03) == pytest.approx(-0.45, abs=0.02)


@given(st.floats(-1.5, 1.5), st.floats(0.0, 2.0))
def test_a_correction_is_never_larger_than_what_the_arm_says(error_mm: float, sigma_mm: float) -> None:
    depth = ReadDepth()
    depth.correct_depth(1e-3 * error_mm, 1e-3 * sigma_mm)
    assert abs(depth.ease_m) <= abs(1e-3 * error_mm)
    assert depth.ease_m * error_mm <= 0.0
