"""Interlocks on what arms and operators report besides motion: wrench, pressure, external torque, enabling device."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.control.interlocks.body_regions import BODY_REGIONS
from touchcell.control.interlocks.config import build_interlocks, parse_interlocks
from touchcell.control.interlocks.coverage import ArmFacts, CellFacts, SensorFacts
from touchcell.control.interlocks.snapshot import ArmView, CellView, SensorView
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.control.latch import Latch
from touchcell.control.proof import Proof, prove
from touchcell.control.supervisor import Supervisor
from touchcell.drivers.core.commands import TwistCommand, TwistFrame
from touchcell.drivers.core.enabling import EnablingPosition
from touchcell.drivers.core.gate import TwistLimits
from touchcell.drivers.core.samples import Stamped, TcpState
from touchcell.errors import ConfigError

CYCLE_NS = 10_000_000
LIMITS = TwistLimits(0.1, 0.5, 0.5, 2.5, 50.0, 250.0)
WRENCH = {"kind": "wrench", "arm": "arm", "limit_n": 30, "limit_nm": 5}
PRESSURE = {"kind": "pressure", "arm": "arm", "regions": ["palm_other"], "contact_area_mm2": 100}
TORQUE = {"kind": "external_torque", "arm": "arm", "limit_nm": 10}
HOLD = {"kind": "hold_to_run", "limit_ms": 100}
SECOND = {"kind": "depth_disagrees", "limit_mm": 3, "states": ["press"]}


class Run:
    """One interlock in a supervisor, cycle after cycle."""

    def __init__(self, entry: dict[str, Any], **mounts: Any) -> None:
        interlocks = build_interlocks(parse_interlocks({"it": entry}), mounts or {"sensor": np.eye(4)})
        self.supervisor = Supervisor(interlocks, Latch())
        self.k = 0

    def __call__(
        self,
        wrench: Any = None,
        *,
        torque: Any = None,
        age_ms: int = 0,
        z_mm: float = 0.0,
        x_mm: float = 0.0,
        moves: float = 0.0,
        command: float | None = None,
        enabling: EnablingPosition | None = None,
        depth_mm: float | None = None,
        state: str = "press",
    ) -> Violation | None:
        self.k += 1
        now_ns = 10**12 + self.k * CYCLE_NS
        t_ns = now_ns - age_ms * 10**6
        T = np.eye(4)
        T[:3, 3] = 1e-3 * x_mm, 0.0, 1e-3 * z_mm
        arm = ArmView(
            Stamped(TcpState(T, np.array([moves, 0, 0, 0, 0, 0.0])), now_ns, self.k),
            None
            if command is None
            else TwistCommand(np.array([command, 0, 0, 0, 0, 0.0]), TwistFrame.BASE, now_ns, 0.03),
            wrench=None if wrench is None else Stamped(np.array(wrench, dtype=float), t_ns, self.k),
            external_torque=None if torque is None else Stamped(np.array(torque, dtype=float), t_ns, self.k),
        )
        sensor = SensorView(
            now_ns, self.k, depth_mm is not None, None if depth_mm is None else 1e-3 * depth_mm, arm="arm"
        )
        view = CellView(
            now_ns,
            {"arm": arm},
            {"sensor": sensor},
            state,
            enabling=None if enabling is None else Stamped(enabling, t_ns, self.k),
        )
        violations = self.supervisor.review(view).violations
        return violations[0] if violations else None


@pytest.mark.parametrize(
    ("wrench", "unit"),
    [((0, 24, 18.1, 0, 0, 0), "N"), ((0, 0, 0, 3, 4.1, 0), "N m"), ((-31, 0, 0, 0, 0, 0), "N")],
)
def test_force_and_torque_count_by_their_norms(wrench: Any, unit: str) -> None:
    run = Run(WRENCH)
    assert run((0, 24, 17.9, 0, 0, 0)) is None
    assert run((0, 0, 0, 3, 3.9, 0)) is None
    found = run(wrench)
    assert found is not None
    assert (found.subject, found.severity, found.unit) == ("arm", Severity.TRIP, unit)


def test_a_force_that_was_too_large_counts_down_to_four_fifths_and_may_be_held_for_a_moment() -> None:
    run = Run({**WRENCH, "hold_ms": 20})
    assert [run((31, 0, 0, 0, 0, 0)) is None for _ in range(3)] == [True, True, False]
    assert run((25, 0, 0, 0, 0, 0)) is not None
    assert run((23.9, 0, 0, 0, 0, 0)) is None
    assert run((25, 0, 0, 0, 0, 0)) is None


@pytest.mark.parametrize("entry", [WRENCH, PRESSURE])
def test_a_wrench_that_is_missing_or_old_is_a_fault(entry: dict[str, Any]) -> None:
    assert Run(entry)((0,) * 6, age_ms=200) is None
    for seen in ({"wrench": None}, {"wrench": (0,) * 6, "age_ms": 201}, {"wrench": (0,) * 6, "age_ms": -1}):
        found = Run(entry)(**seen)
        assert found is not None
        assert found.severity is Severity.FAULT
        assert "no fresh wrench" in found.reason


def test_an_external_torque_may_be_held_for_its_time() -> None:
    run = Run({**TORQUE, "hold_ms": 20})
    assert [run(torque=(11, 0)) is None for _ in range(3)] == [True, True, False]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_wrench_or_a_torque_that_is_not_finite_is_found_first(bad: float) -> None:
    for seen in ({"wrench": (0, 0, bad, 0, 0, 0)}, {"torque": (0, bad)}):
        found = Run(WRENCH)(**seen)  # type: ignore[arg-type]
        assert found is not None
        assert found.interlock == "finite"


def test_each_joint_has_its_own_torque_limit() -> None:
    run = Run({**TORQUE, "limit_nm": [10, 2]})
    assert run(torque=(-9.9, 1.9)) is None
    found = run(torque=(0, -2.1))
    assert found is not None
    assert (found.value, found.limit, found.unit) == (pytest.approx(105), 100, "%")
    assert run(torque=(0, 1.7)) is not None, "down to four fifths"
    assert run(torque=(0, 1.5)) is None
    missing = run()
    assert missing is not None
    assert missing.severity is Severity.FAULT


def test_the_table_has_every_region_once_and_no_transient_contact_with_the_head() -> None:
    assert [region.number for region in BODY_REGIONS.values()] == list(range(1, 30))
    assert [r.number for r in BODY_REGIONS.values() if r.transient is None] == [1, 2, 3]
    assert min(r.force_n for r in BODY_REGIONS.values()) == 65
    assert (min(r.pressure_n_cm2 for r in BODY_REGIONS.values()), BODY_REGIONS["temple"].pressure_n_cm2) == (110, 110)


@pytest.mark.parametrize(
    ("entry", "at_once_n", "lasting_n"),
    [
        # 260 N/cm2 on 1 cm2 would be 260 N: the force limit comes first.
        (PRESSURE, 280, 140),
        # On 10 mm2 the pressure comes first.
        ({**PRESSURE, "contact_area_mm2": 10}, 52, 26),
        # The head knows no transient contact, and the least of several regions counts.
        ({**PRESSURE, "regions": ["palm_other", "masticatory_muscle"]}, 65, 65),
    ],
)
def test_transient_contact_counts_at_once_and_quasi_static_contact_after_half_a_second(
    entry: dict[str, Any], at_once_n: float, lasting_n: float
) -> None:
    assert Run(entry)((at_once_n - 0.1, 0, 0, 0, 0, 0)) is None
    assert Run(entry)((at_once_n + 0.1, 0, 0, 0, 0, 0)) is not None
    run = Run(entry)
    assert [run((lasting_n - 0.1, 0, 0, 0, 0, 0)) for _ in range(80)] == [None] * 80
    run = Run(entry)
    quiet = [run((lasting_n + 0.1, 0, 0, 0, 0, 0)) is None for _ in range(80)]
    assert quiet.index(False) == (50 if at_once_n > lasting_n else 0)


def test_a_region_that_is_none_is_refused() -> None:
    with pytest.raises(ConfigError, match="did you mean 'palm_other'"):
        parse_interlocks({"it": {**PRESSURE, "regions": ["palm_othr"]}})


@pytest.mark.parametrize("moving", [{"moves": 0.01}, {"command": 0.01}, {"command": 0.01, "moves": 0.01}])
@pytest.mark.parametrize(
    ("enabling", "age_ms", "words"),
    [
        (None, 0, "no enabling device"),
        (EnablingPosition.RELEASED, 0, "released"),
        (EnablingPosition.COMPRESSED, 0, "compressed"),
        (EnablingPosition.ENABLED, 101, "101 ms ago"),
        (EnablingPosition.ENABLED, -1, "-1 ms ago"),
    ],
)
def test_nothing_moves_unless_the_device_is_held(
    moving: dict[str, float], enabling: EnablingPosition | None, age_ms: int, words: str
) -> None:
    run = Run(HOLD)
    assert run(enabling=EnablingPosition.ENABLED, age_ms=100, **moving) is None  # type: ignore[arg-type]
    found = run(enabling=enabling, age_ms=age_ms, **moving)  # type: ignore[arg-type]
    assert found is not None
    assert found.subject == "arm"
    assert words in found.reason
    still = Run(HOLD)
    assert still(enabling=enabling, age_ms=age_ms, command=0.0) is None, "at rest it may be let go"


def touch(run: Run) -> None:
    assert run(z_mm=0.0) is None
    assert run(z_mm=0.0, depth_mm=0.0) is None


def press(run: Run, true_mm: list[float], read_mm: list[float], **seen: Any) -> int | None:
    """Cycle of the first violation while a sensor goes in, after it has just touched."""
    touch(run)
    for k, (z, depth) in enumerate(zip(true_mm, read_mm, strict=True)):
        if run(z_mm=z, depth_mm=depth, **seen) is not None:
            return k
    return None


def test_a_network_that_saturates_is_found_by_the_arms_travel() -> None:
    """What a network trained to 7.3 mm reads at true depths up to 30 mm (measured in simulation)."""
    true = [1, 3, 5, 8, 9, 11, 12, 16, 20, 25, 30]
    read = [1, 3, 5, 7.3, 7.9, 8.8, 9.5, 10.7, 7.5, 5.7, 4.0]
    assert press(Run(SECOND), true, read) == true.index(16)
    assert press(Run({**SECOND, "limit_mm": 2}), true, read) == true.index(11)
    assert press(Run(SECOND), true, true) is None


def test_a_contact_that_began_unseen_is_compared_by_its_changes_only() -> None:
    run = Run(SECOND)
    assert run(z_mm=10, depth_mm=3) is None, "no contact was seen to begin"
    assert run(z_mm=12.9, depth_mm=3) is None
    assert run(z_mm=13.1, depth_mm=3) is not None


def test_elsewhere_and_while_it_slides_travel_is_no_depth() -> None:
    run = Run(SECOND)
    touch(run)
    assert run(z_mm=20, depth_mm=3, state="run") is None
    slid = Run(SECOND)
    touch(slid)
    assert slid(z_mm=3, depth_mm=3) is None
    assert slid(z_mm=9, x_mm=5.1, depth_mm=3) is None
    assert slid(z_mm=13, x_mm=5.1, depth_mm=3) is not None, "from there on it counts again"


def test_a_contact_that_is_lost_for_a_moment_keeps_its_reference() -> None:
    run = Run(SECOND)
    touch(run)
    assert run(z_mm=2, depth_mm=2) is None
    for _ in range(20):
        assert run(z_mm=6) is None
    assert run(z_mm=6, depth_mm=2) is not None
    away = Run(SECOND)
    touch(away)
    away(z_mm=2, depth_mm=2)
    for _ in range(60):
        away(z_mm=6)
    assert away(z_mm=6, depth_mm=0.5) is None, "after half a second it is another contact"


def test_force_counts_as_depth_by_the_stiffness_in_every_state() -> None:
    run = Run({**SECOND, "stiffness_n_mm": 2.0})
    assert run((0, 0, 0, 0, 0, 0), z_mm=0) is None
    assert run((0, 0, -10, 0, 0, 0), depth_mm=5, state="run") is None
    found = run((0, 0, -20, 0, 0, 0), depth_mm=5, state="run")
    assert found is not None
    assert found.value == pytest.approx(5.0)
    missing = run(depth_mm=5)
    assert missing is not None
    assert missing.severity is Severity.FAULT


@given(way=st.lists(st.floats(0.0, 12.0), min_size=1, max_size=20), error=st.floats(-2.9, 2.9))
def test_an_estimate_within_the_limit_never_disagrees(way: list[float], error: float) -> None:
    assert press(Run(SECOND), way, [depth + error for depth in way]) is None


FACTS = CellFacts(
    0.01,
    ("press", "run"),
    {"arm": ArmFacts(LIMITS, 1.0, wrench=True, torque_joints=2)},
    {"sensor": SensorFacts("network", "arm", np.eye(4), 7e-3, 6e-3, 0.1)},
    enabling_device=True,
)
POOR = CellFacts(0.01, ("press", "run"), {"arm": ArmFacts(LIMITS, 1.0)}, dict(FACTS.sensors))


def proofs(entry: dict[str, Any], facts: CellFacts = FACTS) -> tuple[Proof, ...]:
    settings = parse_interlocks({"it": entry})
    (interlock,) = build_interlocks(settings, {"sensor": np.eye(4)})
    return prove("it", settings["it"], interlock, facts)


@pytest.mark.parametrize("entry", [WRENCH, PRESSURE, TORQUE, HOLD, SECOND, {**SECOND, "stiffness_n_mm": 1.0}])
def test_each_of_them_is_proven_where_it_can_trip_and_refused_where_not(entry: dict[str, Any]) -> None:
    assert all(proof.tripped_s is not None for proof in proofs(entry)), proofs(entry)
    if entry is not SECOND:
        assert any(proof.problem and proof.fatal for proof in proofs(entry, POOR))


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        ({**WRENCH, "limit_n": 1e5}, "does not trip"),
        ({**WRENCH, "limit_nm": 1e5}, "does not trip"),
        ({**WRENCH, "hold_ms": 1e6}, "does not trip"),
        ({**WRENCH, "arm": "amr"}, "no arm 'amr'"),
        ({**TORQUE, "limit_nm": 1e5}, "does not trip"),
        ({**TORQUE, "limit_nm": [1, 2, 3]}, "2 joints, and 3 limits"),
        ({**TORQUE, "arm": "amr"}, "no arm 'amr'"),
        ({**HOLD, "limit_ms": 1e6}, "does not trip"),
        ({**SECOND, "limit_mm": 50}, "does not trip"),
        ({**SECOND, "states": ["prss"]}, "did you mean 'press'"),
        ({**SECOND, "hold_ms": 1e6}, "does not trip"),
    ],
)
def test_limits_that_nothing_exceeds_are_refused(entry: dict[str, Any], words: str) -> None:
    assert any(words in f"{p.problem} {p.hint}" for p in proofs(entry) if p.fatal), proofs(entry)
