"""Armed coverage of cells: each way in which a cell file disarms an interlock is refused by name, with the key."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from tests.helpers.sampling import sampled
from touchcell.cell.config.armed import advised, cell_facts, proof_table, prove_cell, require_armed
from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.control.interlocks.config import build_interlocks
from touchcell.control.interlocks.planning_scene import PlanningScene
from touchcell.drivers.core.protocols import TwistSink
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

Data = dict[str, Any]
# The model of the other is what a user trains first.
SHIPPED = sorted(path.stem for path in CONFIGS.glob("*.yaml") if path.stem != "replay_real")
PAIR = {
    "in_step": {"kind": "out_of_step", "limit_mm_s": 30, "limit_mm": 4, "hold_ms": 100, "states": ["settle", "run"]},
    "held": {"kind": "object_lost", "limit_ms": 200, "states": ["settle", "run"]},
    "upright": {
        "kind": "toppling",
        "limit_deg": 5,
        "limit_deg_s": 10,
        "limit_mm": 3,
        "hold_ms": 100,
        "states": ["settle", "run"],
    },
    "slip": {"kind": "slip", "limit_ratio": 1.0, "hold_ms": 100, "states": ["run"]},
    "torsion": {"kind": "torsion", "limit_deg": 6},
    "second": {"kind": "depth_disagrees", "limit_mm": 4, "hold_ms": 50, "states": ["approach", "settle"]},
}
TRUE_CONTACT = {"kind": "true_contact"}


def two_arms() -> Data:
    """The shipped cell of two arms with every interlock that it can have."""
    data: Data = yaml.safe_load((CONFIGS / "dual_push_sim.yaml").read_text())
    data["interlocks"] |= copy.deepcopy(PAIR)
    return data


def planned(data: Data, tmp_path: Path) -> CellPlan:
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data, sort_keys=False))
    return plan_cell(path)


def refusals(data: Data, tmp_path: Path) -> list[ConfigError]:
    with pytest.raises(InvalidCell) as caught:
        planned(data, tmp_path)
    return list(caught.value.problems)


@pytest.mark.parametrize("name", SHIPPED)
def test_every_shipped_cell_is_armed(name: str) -> None:
    plan = plan_cell(CONFIGS / f"{name}.yaml")
    assert all(proof.tripped_s is not None for proof in plan.proofs)
    assert {proof.interlock for proof in plan.proofs} == set(plan.cell.interlocks)


def test_a_cell_with_every_interlock_of_two_arms_is_armed(tmp_path: Path) -> None:
    plan = planned(two_arms(), tmp_path)
    assert {proof.interlock for proof in plan.proofs} == set(two_arms()["interlocks"])
    lines = proof_table(plan)
    assert lines[0].split() == [
        "interlock",
        "kind",
        "subject",
        "limit",
        "trips",
        "at",
        "after",
        "stops",
        "within",
        "margin",
        "left",
    ]
    (depth,) = [line for line in lines if line.startswith("indentation") and "leader" in line]
    assert depth.split()[1:] == [
        "depth",
        "leader_sensor",
        "7",
        "mm",
        "pressed",
        "in",
        "by",
        "7.14",
        "mm",
        "0",
        "ms",
        "-",
        "-",
    ]
    (wall,) = [line for line in lines if line.startswith("leader_box") and "400 mm" in line]
    assert wall.split("  ")[-1].strip() == "5.7 mm"


def interlock(data: Data, name: str, **changes: Any) -> None:
    data["interlocks"][name] |= changes


def drop(data: Data, *names: str) -> None:
    for name in names:
        del data["interlocks"][name]


def estimator(data: Data, **changes: Any) -> None:
    for sensor in data["sensors"].values():
        sensor["estimator"] = {**sensor["estimator"], **changes}


def without_filter(data: Data) -> None:
    for sensor in data["sensors"].values():
        sensor["estimator"] = {k: v for k, v in sensor["estimator"].items() if k != "filter"}


def true_contact(data: Data, *kept: str) -> None:
    for sensor in data["sensors"].values():
        sensor["estimator"] = dict(TRUE_CONTACT)
    drop(data, *({"uncertain", "exposure", "out_of_range", "inconsistent"} - set(kept)))


def add(data: Data, name: str, **entry: Any) -> None:
    data["interlocks"][name] = entry


DISARMED: dict[str, tuple[Callable[[Data], Any], str, str]] = {
    "no box for the follower": (lambda d: drop(d, "follower_box"), "interlocks", "'follower'"),
    "no box for the leader": (lambda d: drop(d, "leader_box"), "interlocks", "'leader'"),
    "two boxes for one arm": (
        lambda d: interlock(d, "follower_box", **d["interlocks"]["leader_box"]),
        "interlocks",
        "'follower'",
    ),
    "the other arm's lever": (
        lambda d: interlock(d, "leader_box", sensor="follower_sensor"),
        "interlocks.leader_box.sensor",
        "follower_sensor is mounted on follower, not on leader",
    ),
    "the tool without its sensor": (
        lambda d: d["interlocks"]["leader_box"].pop("sensor"),
        "interlocks.leader_box.sensor",
        "leader_sensor at its end is not guarded",
    ),
    "the other arm's axis": (
        lambda d: interlock(d, "leader_tilt", sensor="follower_sensor"),
        "interlocks.leader_tilt.sensor",
        "not on leader",
    ),
    "a box of 1 km": (
        lambda d: interlock(d, "leader_box", min_mm=[-1e6] * 3, max_mm=[1e6] * 3),
        "interlocks.leader_box.min_mm",
        "out of the arm's reach",
    ),
    "one wall 1 km away": (
        lambda d: interlock(d, "leader_box", max_mm=[400, 1e6, 120]),
        "interlocks.leader_box.max_mm",
        "y = 1e+06 mm is out of the arm's reach",
    ),
    "a cone of everything": (
        lambda d: interlock(d, "leader_tilt", limit_deg=180),
        "interlocks.leader_tilt.limit_deg",
        "does not trip",
    ),
    "no margin": (
        lambda d: d["interlocks"]["leader_box"].pop("margin_mm"),
        "interlocks.leader_box.margin_mm",
        "is missing",
    ),
    "a speed that no arm has": (
        lambda d: interlock(d, "tcp_speed", limit_m_s=100.0),
        "interlocks.tcp_speed.limit_m_s",
        "does not trip",
    ),
    "a rotation that no arm has": (
        lambda d: interlock(d, "tcp_speed", limit_rad_s=100.0),
        "interlocks.tcp_speed.limit_rad_s",
        "does not trip",
    ),
    "a depth beyond the network": (
        lambda d: interlock(d, "indentation", limit_mm=9),
        "interlocks.indentation.limit_mm",
        "pressed in by 7.33 mm: does not trip",
    ),
    "a depth of half a metre on true contact": (
        lambda d: (true_contact(d), interlock(d, "indentation", limit_mm=500)),
        "interlocks.indentation.limit_mm",
        "does not trip",
    ),
    "a depth that only limits": (
        lambda d: interlock(d, "indentation", severity="limit"),
        "interlocks",
        "'depth' that stops guards sensor",
    ),
    "frames of a week": (
        lambda d: interlock(d, "stale_frame", limit_ms=1e9),
        "interlocks.stale_frame.limit_ms",
        "silent: does not trip within 1 s",
    ),
    "arm states of a week": (
        lambda d: interlock(d, "stale_arm", limit_ms=1e9),
        "interlocks.stale_arm.limit_ms",
        "silent: does not trip within 1 s",
    ),
    "no frame age": (lambda d: drop(d, "stale_frame"), "interlocks", "'frame_age'"),
    "no arm state age": (lambda d: drop(d, "stale_arm"), "interlocks", "'arm_state_age'"),
    "no speed": (lambda d: drop(d, "tcp_speed"), "interlocks", "'tcp_speed'"),
    "no depth": (lambda d: drop(d, "indentation"), "interlocks", "'depth'"),
    "a network whose range nothing watches": (lambda d: drop(d, "out_of_range"), "interlocks", "'out_of_range'"),
    "a picture frozen for a week": (
        lambda d: interlock(d, "frozen_frame", limit_ms=1e9),
        "interlocks.frozen_frame.limit_ms",
        "does not trip within 2 s",
    ),
    "twice as dark": (
        lambda d: interlock(d, "exposure", limit_percent=200),
        "interlocks.exposure.limit_percent",
        "black images: does not trip",
    ),
    "exposure of true contact": (
        lambda d: true_contact(d, "exposure"),
        "interlocks.exposure.kind",
        "true contact has no images",
    ),
    "uncertain true contact": (
        lambda d: true_contact(d, "uncertain"),
        "interlocks.uncertain.kind",
        "true contact reports no standard deviation",
    ),
    "out of range of true contact": (
        lambda d: true_contact(d, "out_of_range"),
        "interlocks.out_of_range.kind",
        "true contact has no training range",
    ),
    "uncertain by a metre": (
        lambda d: interlock(d, "uncertain", limit_mm=1000),
        "interlocks.uncertain.limit_mm",
        "does not trip",
    ),
    "uncertain for a week": (
        lambda d: interlock(d, "uncertain", hold_ms=1e9),
        "interlocks.uncertain.limit_mm",
        "does not trip within 2 s",
    ),
    "leave above the limit": (
        lambda d: interlock(d, "uncertain", leave_mm=2.0),
        "interlocks.uncertain",
        "leave_mm 2 is above limit_mm 1.5",
    ),
    "inconsistent without a filter": (without_filter, "interlocks.inconsistent.kind", "has no filter"),
    "inconsistent for a thousand frames": (
        lambda d: interlock(d, "inconsistent", frames=1000),
        "interlocks.inconsistent.limit_nis",
        "does not trip",
    ),
    "inconsistent beyond belief": (
        lambda d: interlock(d, "inconsistent", limit_nis=1e9),
        "interlocks.inconsistent.limit_nis",
        "does not trip",
    ),
    "markers of an image network": (
        lambda d: add(d, "markers", kind="markers_lost", limit_percent=10),
        "interlocks.markers.kind",
        "detects no markers",
    ),
    "contact lost for a week": (
        lambda d: interlock(d, "contact_lost", limit_ms=1e9),
        "interlocks.contact_lost.limit_ms",
        "does not trip within 2 s",
    ),
    "contact lost in no state": (
        lambda d: interlock(d, "contact_lost", states=["setle", "rnu"]),
        "interlocks.contact_lost.states",
        "no working state 'setle'",
    ),
    "contact lost when done": (
        lambda d: interlock(d, "contact_lost", states=["done"]),
        "interlocks.contact_lost.states",
        "no working state 'done'",
    ),
    "slip in no state": (
        lambda d: interlock(d, "slip", states=["rnu"]),
        "interlocks.slip.states",
        "did you mean 'run'?",
    ),
    "slip beyond the network": (
        lambda d: interlock(d, "slip", limit_ratio=100),
        "interlocks.slip.limit_ratio",
        "does not trip",
    ),
    "shear beyond the network": (
        lambda d: interlock(d, "shear", limit_mm=30),
        "interlocks.shear.limit_mm",
        "does not trip",
    ),
    "torsion beyond the network": (
        lambda d: interlock(d, "torsion", limit_deg=30),
        "interlocks.torsion.limit_deg",
        "does not trip",
    ),
    "object lost in no state": (
        lambda d: interlock(d, "held", states=["settle", "rnu"]),
        "interlocks.held.states",
        "no working state 'rnu'",
    ),
    "object lost for a week": (
        lambda d: interlock(d, "held", limit_ms=1e9),
        "interlocks.held.limit_ms",
        "does not trip",
    ),
    "object lost between one sensor": (
        lambda d: interlock(d, "held", follower_sensor="leader_sensor"),
        "interlocks.held.follower_sensor",
        "are one sensor",
    ),
    "out of step with one sensor": (
        lambda d: interlock(d, "in_step", follower_sensor="leader_sensor", follower="leader"),
        "interlocks.in_step.follower_sensor",
        "are one sensor",
    ),
    "out of step with an arm that is none": (
        lambda d: interlock(d, "in_step", leader="ledaer"),
        "interlocks.in_step.leader",
        "did you mean 'leader'?",
    ),
    "out of step with arms exchanged": (
        lambda d: interlock(d, "in_step", leader="follower", follower="leader"),
        "interlocks.in_step.leader",
        "leader_sensor is mounted on leader, not on follower",
    ),
    "out of step at any speed": (
        lambda d: interlock(d, "in_step", limit_mm_s=1e6),
        "interlocks.in_step.limit_mm_s",
        "does not trip",
    ),
    "out of step by any depth": (
        lambda d: interlock(d, "in_step", limit_mm=20),
        "interlocks.in_step.limit_mm",
        "does not trip",
    ),
    "toppling of arms that are none": (
        lambda d: interlock(d, "upright", arms=["a", "b"]),
        "interlocks.upright.arms",
        "no arm 'a'",
    ),
    "toppling with one sensor twice": (
        lambda d: interlock(d, "upright", sensors=["leader_sensor"] * 2, arms=["leader"] * 2),
        "interlocks.upright.sensors",
        "one sensor twice",
    ),
    "toppling flat": (
        lambda d: interlock(d, "upright", limit_deg=90),
        "interlocks.upright.limit_deg",
        "not below 45",
    ),
    "toppling in free fall": (
        lambda d: interlock(d, "upright", limit_deg_s=1e4),
        "interlocks.upright.limit_deg_s",
        "not below 90",
    ),
    "sliding beyond the network": (
        lambda d: interlock(d, "upright", limit_mm=30),
        "interlocks.upright.limit_mm",
        "does not trip",
    ),
    "toppling in no state": (
        lambda d: interlock(d, "upright", states=["rnu"]),
        "interlocks.upright.states",
        "no working state",
    ),
    "tracking beyond the gate": (
        lambda d: interlock(d, "tracking", limit_mm_s=500),
        "interlocks.tracking.limit_mm_s",
        "does not trip",
    ),
    "standstill by a metre": (
        lambda d: interlock(d, "standstill", limit_mm=1000),
        "interlocks.standstill.limit_mm",
        "does not trip",
    ),
    "standstill that settles for a week": (
        lambda d: interlock(d, "standstill", settle_ms=1e9),
        "interlocks.standstill.limit_mm",
        "does not trip",
    ),
    "limited for a week": (
        lambda d: interlock(d, "limited", limit_ms=1e9),
        "interlocks.limited.limit_ms",
        "does not trip within 10 s",
    ),
    "disagreement of 30 mm": (
        lambda d: interlock(d, "second", limit_mm=30),
        "interlocks.second.limit_mm",
        "does not trip",
    ),
    "disagreement in no state": (
        lambda d: interlock(d, "second", states=["setle"]),
        "interlocks.second.states",
        "no working state 'setle'",
    ),
    "disagreement with a wrench that is not measured": (
        lambda d: interlock(d, "second", stiffness_n_mm=0.6),
        "interlocks.second.stiffness_n_mm",
        "reports no wrench",
    ),
    "clearance of nothing": (
        lambda d: (
            add(d, "clear", kind="clearance", limit_mm=60, slow_mm=70),
            d["arms"]["leader"].update(body=[{"from_mm": [0, 0, 0], "to_mm": [0, 0, -100], "radius_mm": 30}]),
            d["arms"]["follower"].update(
                body=[{"from_mm": [0, 0, 0], "to_mm": [0, 0, -100], "radius_mm": 30}],
                base_pose_mm_deg=[50000, 0, 0, 0, 0, 180],
            ),
        ),
        "interlocks.clear.limit_mm",
        "in none of",
    ),
}


@pytest.mark.parametrize("name", DISARMED)
def test_a_disarmed_interlock_is_refused_by_name_with_key_and_reason(name: str, tmp_path: Path) -> None:
    change, key, reason = DISARMED[name]
    data = two_arms()
    change(data)
    found = [(problem.key, f"{problem.reason}; {problem.hint}") for problem in refusals(data, tmp_path)]
    assert any(where.startswith(key) and reason in why for where, why in found), found


def test_states_that_a_default_names_and_the_task_lacks_are_left_out(tmp_path: Path) -> None:
    data = two_arms()
    del data["interlocks"]["contact_lost"]["states"]
    plan = planned(data, tmp_path)
    assert {proof.states for proof in plan.proofs if proof.interlock == "contact_lost"} == {
        ("approach", "settle", "run")
    }


def test_a_pair_that_is_too_near_is_proven_for_both_arms(tmp_path: Path) -> None:
    data = two_arms()
    for arm in ("leader", "follower"):
        data["arms"][arm]["body"] = [{"from_mm": [0, 0, 0], "to_mm": [0, 0, -100], "radius_mm": 30}]
    add(data, "clear", kind="clearance", limit_mm=60, slow_mm=70)
    plan = planned(data, tmp_path)
    assert {p.subject for p in plan.proofs if p.interlock == "clear" and p.tripped_s == 0.0} == {"leader", "follower"}


def test_links_of_a_jointed_arm_are_proven_from_its_chain(tmp_path: Path) -> None:
    data = yaml.safe_load((CONFIGS / "object_track_panda_sim.yaml").read_text())
    add(data, "clear", kind="clearance", limit_mm=60, slow_mm=70)
    data["obstacles"] = {"table": {"pose_mm_deg": [600, 0, -100, 0, 0, 0], "size_mm": [300, 300, 50]}}
    plan = planned(data, tmp_path)
    assert [p.tripped_s for p in plan.proofs if p.interlock == "clear"] == [0.0]


def test_at_activation_the_interlocks_in_use_are_proven_once_more(tmp_path: Path) -> None:
    """A rule that was built from other settings than those of the file is found."""
    plan = planned(two_arms(), tmp_path)
    facts = cell_facts(plan)
    poses = {role: sensor.T_tcp_sensor for role, sensor in facts.sensors.items()}
    good = build_interlocks(plan.cell.interlocks, poses, facts.scene)
    require_armed(plan, good, facts.scene)
    wrong = dict(plan.cell.interlocks)
    wrong["indentation"] = wrong["indentation"].model_copy(update={"limit_mm": 9.0})
    with pytest.raises(ConfigError) as caught:
        require_armed(plan, build_interlocks(wrong, poses, facts.scene), facts.scene)
    assert caught.value.key == "interlocks.indentation.limit_mm"


def test_nothing_is_required_of_a_task_that_moves_nothing(tmp_path: Path) -> None:
    data = yaml.safe_load((CONFIGS / "replay_real.yaml").read_text())
    data["sensors"]["sensor"]["estimator"]["model"] = "builtin:sim_gdn"
    plan = planned(data, tmp_path)
    assert plan.proofs == ()
    assert proof_table(plan) == []


def _numbers(entry: Data) -> list[str]:
    return [key for key, value in entry.items() if isinstance(value, int | float) and not isinstance(value, bool)]


def mutated(rng: np.random.Generator) -> tuple[Data, bool, str]:
    """A random change to the cell of two arms, whether it disarms anything, and what it is."""
    data = two_arms()
    names = list(data["interlocks"])
    name = names[rng.integers(len(names))]
    entry = data["interlocks"][name]
    kind = rng.integers(4)
    if kind == 0:
        del data["interlocks"][name]
        vital = {"leader_box", "follower_box", "tcp_speed", "indentation", "stale_frame", "stale_arm", "out_of_range"}
        return data, name in vital, f"without {name}"
    if kind == 1 and "states" in entry:
        place = rng.integers(len(entry["states"]))
        entry["states"][place] = entry["states"][place][::-1]
        return data, True, f"states of {name}"
    roles = [key for key in ("arm", "sensor") if key in entry]
    if kind == 2 and roles:
        key = roles[rng.integers(len(roles))]
        old = entry[key]
        entry[key] = old.replace("leader", "x").replace("follower", "leader").replace("x", "follower")
        return data, True, f"{key} of {name}"
    keys = [key for key in _numbers(entry) if key.startswith(("limit_", "hold_", "frames", "settle_"))]
    if not keys:
        axis, far = int(rng.integers(3)), bool(rng.integers(2))
        corner = entry["max_mm"]
        corner[axis] = corner[axis] + (1e5 if far else 5)
        return data, far, f"{name}.max_mm[{axis}] {'far' if far else 'near'}"
    key = keys[rng.integers(len(keys))]
    if rng.integers(2):
        # 45 deg, 90 deg/s, 1 s, ...: far beyond whatever a cell can show. A tilt stays within its type.
        entry[key] = 180 if entry["kind"] == "tilt" else 10**6
        return data, True, f"{name}.{key} huge"
    entry[key] = max(1, int(0.9 * entry[key])) if key == "frames" else 0.95 * entry[key]
    return data, False, f"{name}.{key} a little less"


@pytest.mark.parametrize("part", sampled(range(8), 1))
def test_of_cells_changed_at_random_those_that_are_disarmed_are_refused_and_no_others(
    part: int, tmp_path: Path
) -> None:
    """25 cells, in eight parts."""
    rng = np.random.default_rng(20261129 + part)
    wrong = []
    counts = {True: 0, False: 0}
    for _ in range(25):
        data, disarmed, what = mutated(rng)
        counts[disarmed] += 1
        try:
            planned(data, tmp_path)
        except InvalidCell as error:
            if not disarmed:
                wrong.append((what, str(error)))
        else:
            if disarmed:
                wrong.append((what, "accepted"))
    assert wrong == []
    assert min(counts.values()) > 5, counts


def test_facts_of_a_network_are_those_of_its_model_file(tmp_path: Path) -> None:
    plan = planned(two_arms(), tmp_path)
    sensor = cell_facts(plan).sensors["leader_sensor"]
    assert sensor.depth_m == pytest.approx(7.332e-3, abs=1e-6)
    assert sensor.torsion_rad == pytest.approx(0.1277, abs=1e-4)
    assert (sensor.leaves_range, sensor.innovations, sensor.images, sensor.markers) == (True, True, True, False)
    assert sensor.arm == "leader"
    assert sensor.frame_rate_hz == 30.0


def test_the_proofs_of_a_plan_are_those_of_its_own_interlocks(tmp_path: Path) -> None:
    plan = planned(two_arms(), tmp_path)
    assert prove_cell(plan, cell_facts(plan)) == plan.proofs
    with pytest.raises(ValueError, match="shorter"):
        prove_cell(plan, cell_facts(plan), ())
    assert isinstance(cell_facts(plan).scene, PlanningScene)


@pytest.mark.parametrize(
    "cell", sorted(path.name for path in {*CONFIGS.glob("*_sim.yaml"), *CONFIGS.glob("*_bench.yaml")})
)
def test_every_shipped_cell_that_moves_by_images_trips_on_frozen_and_badly_exposed_ones(cell: str) -> None:
    plan = plan_cell(CONFIGS / cell, to_run=False)
    by_images = any(each.estimator.kind in ("network", "edge_network") for each in plan.cell.sensors.values())
    moving = [each for each in plan.arms.values() if TwistSink in each.spec.capabilities.provides]
    if not by_images or not moving:
        return
    kinds = {each.kind for each in plan.cell.interlocks.values()}
    assert kinds >= {"frame_frozen", "exposure"}
    assert not list(advised(plan))


def test_a_cell_that_moves_by_images_is_advised_what_tells_of_frozen_and_dark_ones(tmp_path: Path) -> None:
    data = two_arms()
    assert not any("advice" in note for note in planned(data, tmp_path).notes)
    drop(data, "exposure")
    assert planned(data, tmp_path).notes[0] == (
        "advice   follower_sensor, leader_sensor: nothing trips when its images turn dark or bright: add exposure"
    )
    drop(data, "frozen_frame")
    assert "freeze or turn dark or bright: add frame_frozen and exposure" in planned(data, tmp_path).notes[0]
    data["interlocks"]["exposure"] = {"kind": "exposure", "limit_percent": 15}
    true_contact(data)
    assert not any("advice" in note for note in planned(data, tmp_path).notes)
