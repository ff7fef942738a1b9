"""Interlocks see the readings and settings of devices that are neither arms nor tactile sensors."""

from __future__ import annotations

import math

import pytest

from touchcell.control.interlocks.basic import Finite
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.coverage import CellFacts
from touchcell.control.interlocks.snapshot import CellView, DeviceView
from touchcell.control.proof import prove
from touchcell.drivers.core.samples import Stamped
from touchcell.errors import ConfigError

NOW = 1_000_000_000


def view(t_ns: int = NOW, reading: float = 1.0, setting: float = 2.0) -> CellView:
    sample = Stamped({"force_n": reading}, t_ns, 1)
    return CellView(NOW, devices={"gripper": DeviceView(sample, {"width_mm": setting}), "lamp": DeviceView()})


@pytest.mark.parametrize(("age_ms", "stale"), [(0, False), (50, False), (51, True), (-1, True)])
def test_a_reading_may_be_as_old_as_its_limit_and_not_from_the_future(age_ms, stale):
    (rule,) = build_interlocks(parse_interlocks({"fresh": {"kind": "reading_age", "limit_ms": 50}}), {})
    found = rule.check(view(NOW - age_ms * 1_000_000))
    assert (found is not None) is stale
    if found is not None:
        assert (found.subject, found.unit, found.limit) == ("gripper", "s", 0.05)
        assert found.value == pytest.approx(1e-3 * age_ms)


@pytest.mark.parametrize("wrong", [{"reading": math.nan}, {"reading": math.inf}, {"setting": math.nan}])
def test_no_number_that_is_not_finite_gets_past_the_supervisor(wrong):
    assert Finite().check(view()) is None
    found = Finite().check(view(**wrong))
    assert found is not None
    assert found.subject == "gripper"


def health_view(age_ms: int = 0, **readings: float | str | bool) -> CellView:
    return CellView(NOW, health={"left": Stamped(readings, NOW - age_ms * 1_000_000, 1)})


def rule_of(**keys: object):
    (rule,) = build_interlocks(parse_interlocks({"warm": {"kind": "reading", "device": "left", **keys}}), {})
    return rule


@pytest.mark.parametrize(
    ("readings", "reason"),
    [
        ({"motor_c": 60.0}, ""),
        ({"motor_c": 60.1}, "motor_c is 60.1, most 60"),
        ({"motor_c": 9.9}, "motor_c is 9.9, least 10"),
        ({"motor_c": math.nan}, "motor_c is nan, most 60"),
        ({"motor_c": "hot"}, "not a number"),
        ({"motor_c": True}, "motor_c is 1, least 10"),
    ],
)
def test_what_a_device_reports_about_itself_stays_within_limits(readings, reason):
    violation, _ = rule_of(name="motor_c", limit=60.0, least=10.0).evaluate(health_view(**readings), {})
    assert (violation is None) == (not reason)
    if violation is not None:
        assert reason in violation.reason
        assert violation.subject == "left"


def test_health_that_is_old_or_missing_violates_a_limit_on_it():
    rule = rule_of(name="motor_c", limit=60.0)
    stale, _ = rule.evaluate(health_view(3100, motor_c=30.0), {})
    assert stale is not None
    missing, since = rule.evaluate(health_view(other=1.0), {})
    assert missing is None
    later = CellView(NOW + 3_100_000_000)
    gone, _ = rule.evaluate(later, since)
    assert gone is not None
    assert "reports no 'motor_c'" in gone.reason


@pytest.mark.parametrize("keys", [{}, {"limit": 1.0, "least": 1.0}])
def test_a_limit_that_limits_nothing_is_refused(keys):
    with pytest.raises(ConfigError, match=r"limit"):
        rule_of(name="motor_c", **keys)


@pytest.mark.parametrize("keys", [{"limit": 60.0}, {"least": 40.0}, {"limit": 0.0, "least": -1.0}])
def test_the_proof_makes_it_trip_on_each_side_and_on_silence(keys):
    settings = parse_interlocks({"warm": {"kind": "reading", "device": "left", "name": "x", **keys}})
    (rule,) = build_interlocks(settings, {})
    within = sum(keys.values()) / len(keys)
    facts = CellFacts(0.01, (), {}, {}, health={"left": {"x": within}})
    proofs = prove("warm", settings["warm"], rule, facts)
    assert len(proofs) == len(keys) + 1
    assert all(proof.tripped_s is not None and not proof.problem for proof in proofs)


def test_a_device_without_health_cannot_be_limited():
    settings = parse_interlocks({"warm": {"kind": "reading", "device": "lefd", "name": "x", "limit": 1.0}})
    (rule,) = build_interlocks(settings, {})
    (proof,) = prove("warm", settings["warm"], rule, CellFacts(0.01, (), {}, {}, health={"left": {}}))
    assert proof.problem
    assert "left" in proof.hint
