import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.push_model import Contact, PushEstimator, PushModel, half_between
from touchcell.control.push_steering import Plan, Pose, steer

NO_PLAN = Plan(0.0, 0.0, math.inf)
# Friction radii from a disc's, two thirds of the reach, to that of an oblong box pushed at its long side.
MODELS = st.builds(
    lambda reach_m, offset, lever: PushModel(reach_m, offset * reach_m, (lever * reach_m) ** 2),
    st.floats(0.02, 0.06),
    st.floats(-0.5, 0.5),
    st.floats(0.6, 0.95),
)


class PushedObject:
    """An object under quasi-static friction that a contact which sticks pushes."""

    def __init__(self, model: PushModel, heading_rad: float = 0.0) -> None:
        self.model = model
        self.center = Pose(0.0, 0.0, heading_rad)

    @property
    def contact(self) -> Contact:
        at = self.center.ahead(-self.model.offset_m, 0.5 * math.pi).ahead(-self.model.reach_m)
        return Contact(at.x, at.y, self.center.heading)

    def push(self, ahead_m_s: float, left_m_s: float, dt_s: float) -> None:
        """Move by the velocity of the contact; the limit surface alone says how."""
        a, s, c2 = self.model.reach_m, self.model.offset_m, self.model.lever_m2
        # omega = (s f_n - a f_l) / c^2 with f = v, and v_n = u_n - s omega, v_l = u_l + a omega.
        turn = (s * ahead_m_s - a * left_m_s) / (c2 + a * a + s * s)
        n, left = ahead_m_s - s * turn, left_m_s + a * turn
        middle = self.center.heading + 0.5 * turn * dt_s
        self.center = Pose(
            self.center.x + (n * math.cos(middle) - left * math.sin(middle)) * dt_s,
            self.center.y + (n * math.sin(middle) + left * math.cos(middle)) * dt_s,
            self.center.heading + turn * dt_s,
        )


@given(MODELS, st.floats(0.01, 0.1), st.floats(-5.0, 5.0))
def test_the_point_ahead_of_the_centre_moves_as_a_unicycle(
    model: PushModel, speed_m_s: float, curvature: float
) -> None:
    thing, dt_s = PushedObject(model), 1e-4
    motion = model.motion(speed_m_s, curvature)
    before = thing.center.ahead(model.lead_m)
    thing.push(motion.contact_ahead_m_s, motion.contact_left_m_s, dt_s)
    after = thing.center.ahead(model.lead_m)
    direction = math.atan2(after.y - before.y, after.x - before.x) - 0.5 * (after.heading + before.heading)
    assert direction == pytest.approx(model.drift_rad, abs=1e-3)
    assert math.hypot(after.x - before.x, after.y - before.y) == pytest.approx(speed_m_s * dt_s, rel=1e-3)
    assert after.heading - before.heading == pytest.approx(curvature * speed_m_s * dt_s, rel=1e-3, abs=1e-9)


@given(MODELS, st.integers(0, 99))
def test_centre_and_lever_are_found_within_a_short_push_whatever_they_are(model: PushModel, seed: int) -> None:
    rng = np.random.default_rng(seed)
    thing = PushedObject(model, heading_rad=0.3)
    estimator = PushEstimator(model.reach_m, (0.75 * model.reach_m) ** 2)
    for k in range(300):
        # 60 mm, weaving a little, seen with noise of 0.1 mm and 0.1 deg.
        thing.push(0.02, 0.003 * math.sin(0.1 * k), 0.01)
        c = thing.contact
        noise = rng.standard_normal(3) * (1e-4, 1e-4, math.radians(0.1))
        estimator.update(Contact(c.x_m + noise[0], c.y_m + noise[1], c.heading_rad + noise[2]))
    # Offset and lever have like effects while the object turns evenly.
    assert estimator.model.offset_m == pytest.approx(model.offset_m, rel=0.25, abs=2.5e-3)


@given(
    MODELS,
    st.floats(-0.05, 0.05),
    st.floats(-0.3, 0.3),
    st.one_of(st.none(), st.floats(-0.4, 0.4)),
)
def test_an_object_that_is_steered_arrives(
    model: PushModel, aside_m: float, heading_rad: float, goal_rad: float | None
) -> None:
    model = PushModel(model.reach_m, 0.3 * model.offset_m, model.lever_m2)
    thing, target, plan = PushedObject(model, heading_rad), (0.3, aside_m), NO_PLAN
    while (plan := steer(thing.center, model, target, goal_rad, 10.0, plan)).remaining_m > 0.0:
        motion = model.motion(0.1, plan.curvature)
        thing.push(motion.contact_ahead_m_s, motion.contact_left_m_s, 0.01)
    assert math.hypot(thing.center.x - target[0], thing.center.y - target[1]) < 2e-3
    if goal_rad is not None:
        assert thing.center.heading == pytest.approx(goal_rad, abs=math.radians(2.0))


@pytest.mark.parametrize("reach_m", [0.03, 0.04])
def test_the_last_centimetre_is_steered_by_the_plan_and_not_by_what_its_frames_read(reach_m: float) -> None:
    model = PushModel(reach_m, 0.0, (0.85 * reach_m) ** 2)
    thing, target, plan = PushedObject(model), (0.06, 1e-3), NO_PLAN
    rng = np.random.default_rng(0)
    while plan.remaining_m > 0.0:
        read = thing.center.heading + rng.normal(0.0, math.radians(1.0 if plan.remaining_m < 0.012 else 0.0))
        plan = steer(Pose(thing.center.x, thing.center.y, read), model, target, None, 10.0, plan)
        motion = model.motion(0.03, plan.curvature)
        thing.push(motion.contact_ahead_m_s, motion.contact_left_m_s, 0.01)
    assert abs(thing.center.y - target[1]) < 0.2e-3


def test_a_target_beyond_the_friction_cone_is_told_to_be_missed() -> None:
    model = PushModel(0.04, 0.0, 9e-4)
    near = steer(Pose(0.0, 0.0, 0.0), model, (0.3, 0.02), None, 0.8, NO_PLAN)
    assert near.miss_m == 0.0
    beside = steer(Pose(0.0, 0.0, 0.0), model, (0.05, 0.3), None, 0.1, NO_PLAN)
    assert beside.miss_m > 0.1
    lowest, highest = model.curvatures(0.1)
    assert lowest <= beside.curvature <= highest


@pytest.mark.parametrize("beside_m", [0.0, 0.012, -0.02])
def test_two_contacts_tell_how_long_an_object_between_them_is(beside_m: float) -> None:
    near = Contact(0.0, 0.0, 0.0)
    assert half_between(near, Contact(0.11, beside_m, math.pi), flat=True) == pytest.approx(0.055)
    angle = math.asin(beside_m / 0.04)
    points = [Contact(-0.04 * math.cos(a), -0.04 * math.sin(a), a) for a in (0.0, math.pi + angle)]
    assert half_between(*points, flat=False) == pytest.approx(0.04)
    assert half_between(near, Contact(0.11, beside_m, math.pi - 0.4), flat=True) is None
    assert half_between(near, Contact(0.0, 0.11, -0.5 * math.pi), flat=False) is None


def test_at_another_distance_of_the_centre_the_object_is_as_much_larger() -> None:
    estimator = PushEstimator(0.04, 0.03**2)
    estimator.change_reach(0.06)
    assert estimator.model.reach_m == 0.06
    assert estimator.model.lever_m2 == pytest.approx(0.045**2)
