"""Interlocks see the readings and settings of devices that are neither arms nor tactile sensors."""

from __future__ import annotations

import math

import pytest

from touchcell.control.interlocks.basic import Finite
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.snapshot import CellView, DeviceView
from touchcell.drivers.core.samples import Stamped

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
