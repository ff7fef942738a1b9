"""What a sensor makes of a touch on its way beside an object."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.kinematic_plant import CONTEXT, T_TCP_SENSOR, KinematicPlant
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.contact_servo import ContactServo, ContactServoConfig
from touchcell.tasks.free_motion import Goal
from touchcell.tasks.interface import Observation
from touchcell.tasks.servoing import ServoConfig, ServoTask

CONFIG = ContactServoConfig(kp_per_s=(0.0,) * 6, ki_per_s2=(0.0,) * 6)
T_S_F = se3.from_euler_mm_deg(np.array([0.0, 0.0, -0.5, 0.0, 0.0, 0.0]))


class Feeling:
    """A behaviour that feels for one contact and takes note of what it is told."""

    feedforward, timeout_s = np.zeros(6), 1.0
    may_sidestep, wants_sidestep, only_touches = True, True, True

    def __init__(self):
        self.told = []

    def update(self, dt_s, before, now, T_s_f):
        return False

    def shortfall(self):
        return ""

    def telemetry(self):
        return {}

    def begin_sidestep(self, T_base_sensor):
        pass

    def begin_approach(self, T_base_sensor):
        pass

    def next_goal(self, T_base_sensor, T_s_f):
        self.told.append(T_s_f)
        ahead = se3.from_euler_mm_deg(np.array([0.0, 0.0, 10.0, 0.0, 0.0, 0.0]))
        return Goal(se3.compose(T_base_sensor, ahead), feels=True)


def felt(first_sigma_deg, sigma_deg):
    """Return what is told of a touch whose normal is known so well, after a first contact that was known so well."""
    feeling = Feeling()
    servo = ContactServo("arm", "sensor", CONFIG, (0.0,) * 6, feeling, CONTEXT)
    state = TcpState(se3.inverse(T_TCP_SENSOR), np.zeros(6))
    for cycle in range(40):
        angle = np.radians(first_sigma_deg if cycle == 0 else sigma_deg)
        belief = PoseGaussian(T_S_F, np.diag([1e-8] * 3 + [angle**2, 1e-6, 1e-6]))
        now_ns = 10_000_000 * (1 + cycle)
        contact = ContactEstimate(True, belief, now_ns, cycle, now_ns, measured=belief, change=0.05)
        servo.update(Observation(now_ns, {"arm": Stamped(state, now_ns, cycle)}, {"sensor": contact}))
        if cycle == 0:
            servo.start_sidestep()
        elif len(feeling.told) < 2:
            servo.step_aside(0.1, 0.01)
    assert len(feeling.told) == 2
    return feeling.told[1]


@pytest.mark.parametrize(("first_deg", "sigma_deg"), [(0.6, 1.2), (2.0, 3.0)])
def test_a_touch_that_is_as_sure_as_the_first_contact_tells_where_it_is(first_deg, sigma_deg):
    assert felt(first_deg, sigma_deg) == pytest.approx(T_S_F)


@pytest.mark.parametrize(("first_deg", "sigma_deg"), [(0.6, 2.0), (2.0, 6.0)])
def test_a_touch_far_beside_the_axis_of_the_tip_tells_nothing(first_deg, sigma_deg):
    """Where the normal's standard deviation is larger it may be any: 12 deg were read of 31, and 2 of 41."""
    assert felt(first_deg, sigma_deg) is None


class LettingGoOnce(Feeling):
    """A behaviour that lets go of the object once, to touch it again at the same place, and then has finished."""

    def update(self, dt_s, before, now, T_s_f):
        return not self.wants_sidestep

    def next_goal(self, T_base_sensor, T_s_f):
        self.told.append(T_s_f)
        self.wants_sidestep = False
        back = se3.from_euler_mm_deg(np.array([0.0, 0.0, -5.0, 0.0, 0.0, 0.0]))
        return Goal(se3.compose(T_base_sensor, back)) if len(self.told) == 1 else None


@pytest.mark.parametrize(("gives_way_mm", "ends"), [(np.inf, "done"), (0.45, "failed")])
def test_an_object_that_was_felt_and_is_then_carried_along_is_not_where_it_was_felt(gives_way_mm, ends):
    config = ServoConfig(kp_per_s=(0.0,) * 6, ki_per_s2=(0.0,) * 6, check_s=0.0)
    servo = ContactServo("arm", "sensor", config, (0.0,) * 6, LettingGoOnce(), CONTEXT)
    plant, task = KinematicPlant(), ServoTask("feel", config, CONTEXT, servo)
    plant.image, plant.gives_way_mm = 0.0, gives_way_mm
    plant.run(task)
    assert task.state == ends
    assert ends == "done" or "carries the object along" in task.transitions[-2].reason
