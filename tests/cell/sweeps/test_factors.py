"""Factors of a sweep: grids, samples, and what is no factor."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.cell.sweeps.factors import Distribution, grid_values, make_factors, sampled_values
from touchcell.errors import ConfigError


def test_a_grid_is_a_range_whole_numbers_or_a_list():
    assert grid_values("k", "1:5:9") == (1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5, 5)
    assert grid_values("k", "3..6") == (3, 4, 5, 6)
    assert grid_values("k", "a, b,c") == ("a", "b", "c")
    assert grid_values("k", "[1, 2],[3, 4]") == ([1, 2], [3, 4])
    assert grid_values("k", [True, None, 2][::2]) == (True, 2)
    assert grid_values("k", 4) == (4,)


@pytest.mark.parametrize("text", ["1:5:0", "5..1", "", "a,,b", "0..99999999", "1:2:99999999"])
def test_an_empty_or_endless_grid_is_refused_by_key(text):
    with pytest.raises(ConfigError) as caught:
        grid_values("task.depth_mm", text)
    assert caught.value.key == "task.depth_mm"


@pytest.mark.parametrize(
    "text",
    ["gauss(0, 1)", "uniform(1)", "uniform(2, 1)", "normal(0, -1)", "loguniform(0, 1)", "uniform(a, b)", "choice()"],
)
def test_what_is_no_distribution_is_refused_with_the_ones_that_are(text):
    with pytest.raises(ConfigError) as caught:
        sampled_values("seed", text)
    assert caught.value.key == "seed"


def test_every_point_of_the_grid_has_the_same_draws():
    factors = make_factors({"a": "1..3", "b": "x,y"}, {"c": "normal(0, 1)", "seed": "1..4"}, None)
    points = list(factors.points())
    assert len(points) == len(factors) == 3 * 2 * 4
    draws = [sampled for _, sampled in points]
    assert draws[:4] == draws[4:8]
    assert [draw["seed"] for draw in draws[:4]] == [1, 2, 3, 4]
    assert len({draw["c"] for draw in draws}) == 4
    again = make_factors({"a": "1..3", "b": "x,y"}, {"c": "normal(0, 1)", "seed": "1..4"}, None)
    assert list(again.points()) == points


def test_a_draw_does_not_depend_on_what_else_is_sampled():
    alone = make_factors({}, {"c": "uniform(0, 1)"}, 3)
    beside = make_factors({}, {"b": "uniform(0, 1)", "c": "uniform(0, 1)"}, 3)
    assert [draw["c"] for _, draw in alone.points()] == [draw["c"] for _, draw in beside.points()]


def test_ranges_of_different_lengths_and_keys_in_both_are_refused():
    with pytest.raises(ConfigError, match="5 values for 3 samples"):
        make_factors({}, {"a": "1..3", "b": "1..5"}, None)
    with pytest.raises(ConfigError, match="both"):
        make_factors({"a": "1..3"}, {"a": "1..3"}, None)
    with pytest.raises(ConfigError, match="trials"):
        make_factors({"a": "1..5000", "b": "1..5000"}, {}, None)


@given(st.floats(-1e6, 1e6), st.floats(0.0, 1e6), st.integers(1, 30))
def test_draws_stay_within_their_range(low, width, samples):
    factors = make_factors({}, {"k": f"uniform({low}, {low + width})"}, samples)
    assert all(low <= draw["k"] <= low + width for _, draw in factors.points())


def test_choices_may_be_anything_that_yaml_can_say():
    draw = sampled_values("k", "choice({kind: plane}, [1, 2], text)")
    assert draw == Distribution("choice", ({"kind": "plane"}, [1, 2], "text"))
