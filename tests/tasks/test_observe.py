"""Observing: no arm, any number of frames, an orderly end."""

from __future__ import annotations

import numpy as np
import pytest

from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.interface import Observation, TaskContext
from touchcell.tasks.observe import SPEC, ObserveConfig

LABELS = np.array([1.0, -2.0, 3.5, 5.0, -6.0, 2.0])
BELIEF = PoseGaussian(se3.inverse(se3.from_euler_mm_deg(LABELS)), 1e-6 * np.eye(6))


def build(**config):
    return SPEC.build(ObserveConfig(**config), TaskContext(100.0, {}))


def look(task, t_s, seq=None, belief=BELIEF, stop=False):
    now_ns = round(t_s * 1e9)
    contacts = {}
    if seq is not None:
        contacts["sensor"] = ContactEstimate(belief is not None, belief, now_ns - 20_000_000, seq, now_ns)
    return task.tick(Observation(now_ns, {}, contacts, stop))


def test_reports_contacts_and_commands_nothing():
    task = build()
    action = look(task, 0.0, 1)
    assert task.state == "observe"
    assert action.twists == {}
    assert action.telemetry["frame_age_ms"] == pytest.approx(20.0)
    names = ("shear_x_mm", "shear_y_mm", "depth_mm", "tilt_alpha_deg", "tilt_beta_deg", "torsion_gamma_deg")
    np.testing.assert_allclose([action.telemetry[name] for name in names], LABELS, atol=1e-9)


def test_without_contact_there_are_no_components():
    assert look(build(), 0.0, 1, belief=None).telemetry == {"frames": 1.0, "frame_age_ms": 20.0, "in_contact": 0.0}


def test_succeeds_when_the_source_has_ended():
    task = build(idle_timeout_s=1.0)
    for k in range(10):
        look(task, 0.1 * k, k)
    look(task, 1.89, 9)
    assert not task.finished
    last = look(task, 1.91, 9)
    assert last.telemetry["frames"] == 10.0
    assert task.succeeded
    assert task.transitions[-1].event == "ended"


def test_fails_when_no_frame_arrives():
    task = build(first_frame_timeout_s=2.0)
    look(task, 0.0)
    look(task, 1.9)
    assert not task.finished
    look(task, 2.0)
    assert task.state == "failed"
    assert not task.succeeded


@pytest.mark.parametrize("seq", [None, 1])
def test_an_operators_stop_ends_it(seq):
    task = build()
    look(task, 0.0, seq)
    look(task, 0.1, seq, stop=True)
    assert task.state == "done"
    assert look(task, 0.2, 2).telemetry == {}


def test_ends_after_its_duration():
    task = build(duration_s=0.5)
    for k in range(6):
        look(task, 0.1 * k, k)
    assert task.state == "done"
    assert task.transitions[-1].event == "timeout"


@pytest.mark.parametrize("seq", [None, 1])
def test_trip(seq):
    task = build()
    look(task, 0.0, seq)
    task.trip(5, "frame age")
    assert task.state == "tripped"
    assert task.transitions[-1].t_ns == 5
    assert not task.succeeded


def test_an_estimate_that_is_no_pose_is_a_fault():
    task = build()

    class Broken:
        mean = np.full((4, 4), np.nan)

    look(task, 0.0, 1, belief=Broken())
    assert task.state == "faulted"
    assert "mean" in task.transitions[-1].reason or "inverse" in task.transitions[-1].reason
