"""Object tracking: all six components, on exact kinematics and on the simulator."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.kinematic_plant import CONTEXT, RATE_HZ, KinematicPlant
from tests.helpers.simulated_loop import SimulatedLoop
from touchcell.geometry import se3
from touchcell.tasks.interface import Task
from touchcell.tasks.object_tracking import SPEC, ObjectTrackingConfig

QUICK = ObjectTrackingConfig(duration_s=4.0, retract_mm=5.0, settle_time_s=0.1)


def build(config: ObjectTrackingConfig = QUICK) -> Task:
    return SPEC.build(config, CONTEXT)


def test_holds_a_resting_plate_for_the_given_time():
    plant, task = KinematicPlant(), build()
    plant.run(task, until="run")
    actions = plant.run(task, until="retract")
    assert len(actions) == pytest.approx(QUICK.duration_s * RATE_HZ, abs=2)
    np.testing.assert_allclose(se3.to_euler_mm_deg(plant.seen), [0, 0, 6.0, 0, 0, 0], atol=1e-3)
    plant.run(task)
    assert task.succeeded


VELOCITIES = [
    *(0.02 * np.eye(6)[:3]),
    *(0.15 * np.eye(6)[3:]),
    np.array([0.01, -0.01, 0.005, 0.1, -0.05, 0.1]),
]


@pytest.mark.parametrize("velocity", VELOCITIES)
def test_integral_action_leaves_no_lag_behind_constant_motion(velocity):
    plant, task = KinematicPlant(), build()
    plant.run(task, until="run")
    plant.velocity = velocity
    plant.run(task, until="retract")
    np.testing.assert_allclose(se3.to_euler_mm_deg(plant.seen), [0, 0, 6.0, 0, 0, 0], atol=0.02)


def test_the_sensor_moves_as_the_object_does():
    plant, task = KinematicPlant(), build()
    plant.run(task, until="run")
    start = plant.T_w_s
    plant.velocity = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.2])
    plant.run(task, until="retract")
    turned = se3.log(se3.compose(se3.inverse(start), plant.T_w_s))
    np.testing.assert_allclose(turned[3:], [0, 0, 0.2 * QUICK.duration_s], atol=0.01)


def test_operator_stop_withdraws():
    plant, task = KinematicPlant(), build()
    plant.run(task, until="run")
    plant.operator_stop = True
    depth_m = plant.sensor_in_surface()[2, 3]
    plant.run(task)
    assert task.state == "stopped"
    assert depth_m - plant.sensor_in_surface()[2, 3] == pytest.approx(1e-3 * QUICK.retract_mm, abs=0.0005)


GLIDES = [np.diag([200.0, 200.0, 100.0, 30.0, 30.0, 60.0])[i] for i in range(6)]


@pytest.mark.parametrize("axis", range(6))
def test_tracks_one_component_at_a_time_in_the_simulator(axis):
    """A plate moves 200 mm at up to 47 mm/s (100 mm along the normal) or turns by 30 or 60 deg."""
    glide = {"kind": "glide", "displacement_mm_deg": tuple(GLIDES[axis]), "start_s": 5.0, "duration_s": 8.0}
    loop = SimulatedLoop({"kind": "plane", "motion": glide}, (0.0, 0.0, 40.0, 180.0, 0.0, 0.0))
    task = SPEC.build(ObjectTrackingConfig(duration_s=11.0), loop.context)
    log = loop.run(task)
    assert task.succeeded
    error = log.labels(after_s=1.0) - [0, 0, 6.0, 0, 0, 0]
    print(f"{GLIDES[axis]}: RMS error {np.sqrt(np.mean(error**2, axis=0)).round(3)} mm, deg")
    np.testing.assert_array_less(np.abs(error).max(axis=0), [1.0, 1.0, 0.5, 0.5, 0.5, 0.5])


def test_tracks_all_components_at_once_in_the_simulator():
    motion = {"kind": "periodic", "amplitude_mm_deg": (60, 60, 20, 8, 8, 15), "period_s": 12.0, "ramp_s": 8.0}
    loop = SimulatedLoop({"kind": "plane", "motion": motion}, (0.0, 0.0, 40.0, 180.0, 0.0, 0.0))
    task = SPEC.build(ObjectTrackingConfig(duration_s=15.0), loop.context)
    log = loop.run(task)
    assert task.succeeded
    rms = np.sqrt(np.mean((log.labels(after_s=1.0) - [0, 0, 6.0, 0, 0, 0]) ** 2, axis=0))
    print(f"all components: RMS error {rms.round(3)} mm, deg")
    np.testing.assert_array_less(rms, [0.5, 0.5, 0.15, 0.2, 0.2, 0.2])
