"""``touchcell bench kinematics``: cost and accuracy of the kinematics.

Prints the time per call, also of distances between arms and obstacles, the deviation of open-loop integration from an
exact path, and the behaviour at a singularity.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from unittest.mock import patch

import numpy as np

from tests.helpers.coal_distance import box_body, capsule_body
from touchcell.cell.bench.provenance import provenance
from touchcell.control.interlocks.collision import Box, Capsule, Clearances
from touchcell.drivers.core.arm import LimitsConfig
from touchcell.drivers.core.joint_setpoint import JointSetpoint
from touchcell.drivers.kinematics.chain import ChainDescription, DifferentialIk, SerialChain, Tool
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_CALLS = 5000
_PAIRS = 128
_RATE_HZ = 250.0
_DIAMETER_M = 0.15
_LAP_S = 8.0
_URDFS = (
    *("ur3_robot.urdf", "ur5_robot.urdf", "ur10_robot.urdf", "ur3_gripper.urdf", "ur5_gripper.urdf"),
    *("panda.urdf#panda_link8", "kinova.urdf", "xarm7.urdf", "z1.urdf#link06", "so100.urdf#jaw"),
    *("so101.urdf#gripper_link", "talos_left_arm.urdf#gripper_left_base_link", "baxter.urdf#left_gripper"),
    *("tiago_no_hand.urdf#torso_lift_link:wrist_ft_tool_link", "pr2.urdf#torso_lift_link:l_gripper_tool_frame"),
    "romeo.urdf#torso:l_wrist",
)
_LIMITS = LimitsConfig().build()


def run(arguments: Sequence[str], out: Path) -> None:
    """Print the figures and write ``kinematics.json`` into ``out``."""
    argparse.ArgumentParser(prog="touchcell bench kinematics", description=__doc__.partition("\n")[0]).parse_args(
        arguments
    )
    chain = SerialChain(ChainDescription.shipped("generic_6r"), Tool(origin_mm=(0, 0, 80), mass_kg=0.15))
    ik = DifferentialIk(chain)
    working = np.deg2rad([0.0, 40.0, 90.0, 0.0, 50.0, 0.0])
    times_us = _times(chain, ik, working)
    faster_us = _engine_times(working)
    arms = _arms()
    distances = _distances()
    path_mm, turn_deg = _circle(chain, ik, working)
    fastest, smallest_m, reach_mm, off_mm = _reach_out(chain, ik, working)
    print(f"{'call, six joints':32s}{'median us':>12s}{'p99 us':>10s}")
    for name, (median_us, p99_us) in times_us.items():
        print(f"{name:32s}{median_us:12.1f}{p99_us:10.1f}")
    if faster_us:
        print("\nby pinocchio")
        for name, (median_us, p99_us) in faster_us.items():
            print(f"{name:32s}{median_us:12.1f}{p99_us:10.1f}")
    for name, joints, worst in arms:
        print(f"{name:56s}{joints:3d} joints, largest deviation from pinocchio {worst:.1e}")
    print(f"\n{f'distances of {_PAIRS} pairs of two arms and four boxes':56s}{'median us':>12s}{'p99 us':>10s}")
    for name, (median_us, p99_us) in distances.items():
        print(f"{name:56s}{median_us:12.1f}{p99_us:10.1f}")
    print(
        f"\ncircle of {_DIAMETER_M * 1e3:.0f} mm in {_LAP_S:g} s at {_RATE_HZ:g} Hz, open loop: off the path at most "
        f"{path_mm:.4f} mm, {turn_deg:.5f} deg"
        f"\nreaching out at 0.1 m/s until it stops: fastest joint {fastest:.2f} rad/s, smallest singular value "
        f"{smallest_m:.4f} m, {reach_mm:.0f} mm further out, off the line at most {off_mm:.2f} mm"
    )
    result = {
        "provenance": provenance(),
        "times_us": times_us,
        "pinocchio_us": faster_us,
        "arms": [{"name": name, "joints": joints, "deviation": worst} for name, joints, worst in arms],
        "distances_us": distances,
        "circle": {"off_mm": path_mm, "off_deg": turn_deg},
        "reach_out": {
            "fastest_joint_rad_s": fastest,
            "smallest_singular_value_m": smallest_m,
            "path_mm": reach_mm,
            "off_mm": off_mm,
        },
    }
    out.mkdir(parents=True, exist_ok=True)
    (out / "kinematics.json").write_text(json.dumps(result, indent=1) + "\n")
    print(f"\nwritten: {out / 'kinematics.json'}")


def _times(chain: SerialChain, ik: DifferentialIk, q: Array) -> dict[str, tuple[float, float]]:
    """Return median and 99th percentile of each call, microseconds."""
    twist = np.array([0.05, 0.02, 0.0, 0.1, 0.0, 0.2])
    near_singular = q * np.array([1.0, 1.0, 1.0, 1.0, 0.1, 1.0])
    setpoint = JointSetpoint(chain, ik, _LIMITS)
    setpoint.reset(q)
    setpoint.follow(twist, 1 << 62)
    for _ in range(60):
        setpoint.step(0, 1.0 / _RATE_HZ)
    calls: dict[str, Callable[[], object]] = {
        "forward": lambda: chain.forward(q),
        "forward and Jacobian": lambda: chain.forward_and_jacobian(q),
        "gravity torques": lambda: chain.gravity_torques(q),
        "differential IK": lambda: ik.solve(q, twist),
        "differential IK near singular": lambda: ik.solve(near_singular, twist),
        "setpoint step": lambda: setpoint.step(0, 0.0),
    }
    return {name: _time(call) for name, call in calls.items()}


def _engine_times(q: Array) -> dict[str, tuple[float, float]]:
    """Return the same of what pinocchio computes; nothing where it is not installed."""
    chain = SerialChain(ChainDescription.shipped("generic_6r"), Tool(origin_mm=(0, 0, 80), mass_kg=0.15))
    if not chain.accelerate():
        return {}
    ik, twist = DifferentialIk(chain), np.array([0.05, 0.02, 0.0, 0.1, 0.0, 0.2])
    return {
        "forward": _time(lambda: chain.forward(q)),
        "forward and Jacobian": _time(lambda: chain.forward_and_jacobian(q)),
        "gravity torques": _time(lambda: chain.gravity_torques(q)),
        "differential IK": _time(lambda: ik.solve(q, twist)),
    }


def _arms() -> list[tuple[str, int, float]]:
    """Return name, joints, and largest deviation of poses and Jacobians of arms from URDF files, plain and faster.

    The files are those of ``example-robot-data``; nothing where it or pinocchio is not installed.
    """
    if importlib.util.find_spec("pinocchio") is None:
        return []
    spec = importlib.util.find_spec("pinocchio")
    assert spec is not None
    assert spec.origin is not None
    folder = Path(spec.origin).parents[4] / "share" / "example-robot-data" / "robots"
    found: list[tuple[str, int, float]] = []
    for name in _URDFS:
        file, _, link = name.partition("#")
        paths = sorted(folder.rglob(file)) if folder.is_dir() else []
        if not paths:
            continue
        plain, fast = (
            SerialChain(ChainDescription.named(f"{paths[0]}#{link}" if link else str(paths[0]))) for _ in "ab"
        )
        fast.accelerate()
        worst = 0.0
        for q in np.random.default_rng(1).uniform(-3.0, 3.0, (50, plain.joint_count)):
            for ours, theirs in zip(plain.forward_and_jacobian(q), fast.forward_and_jacobian(q), strict=True):
                worst = max(worst, float(np.abs(ours - theirs).max()))
            worst = max(worst, float(np.abs(plain.gravity_torques(q) - fast.gravity_torques(q)).max()))
        found.append((name, plain.joint_count, worst))
    return found


def _time(call: Callable[[], object]) -> tuple[float, float]:
    taken = np.empty(_CALLS)
    for k in range(_CALLS):
        start_ns = time.perf_counter_ns()
        call()
        taken[k] = time.perf_counter_ns() - start_ns
    median, p99 = np.percentile(taken, [50, 99]) * 1e-3
    return float(median), float(p99)


def _distances() -> dict[str, tuple[float, float]]:
    """Return how long all distances of a scene take: compiled, in NumPy, and by coal where that is installed."""
    rng = np.random.default_rng(3)
    ends = rng.uniform(-1.0, 1.0, (16, 2, 3))
    capsules = [Capsule(f"part {k}", (1, 1), (tuple(a), tuple(b)), 0.03) for k, (a, b) in enumerate(ends)]
    poses = se3.from_euler_mm_deg(rng.uniform(-1.0, 1.0, (4, 6)) * [1000, 1000, 1000, 180, 80, 180])
    boxes = [Box(f"box {k}", T, rng.uniform(0.05, 0.3, 3)) for k, T in enumerate(poses)]
    arms: dict[str, Sequence[Capsule]] = {"left": capsules[:8], "right": capsules[8:]}
    frames = np.tile(np.eye(4), (4, 1, 1))
    times: dict[str, tuple[float, float]] = {}
    for name, pure in (("compiled", ""), ("in NumPy", "1")):
        with patch.dict(os.environ, {"TOUCHCELL_PURE_PYTHON": pure}):
            found = Clearances(arms, dict.fromkeys(arms, 2), boxes)
        assert len(found.pairs) == _PAIRS
        times[name] = _time(partial(found.distances, frames))
    with suppress(ImportError):
        times["coal, without placing the bodies"] = _time(_coal_distances(found, capsules, boxes, frames))
    return times


def _coal_distances(
    found: Clearances, capsules: Sequence[Capsule], boxes: Sequence[Box], frames: Array
) -> Callable[[], object]:
    """Return a call that finds the distances of the same pairs with coal."""
    import coal

    bodies = {capsule.name: capsule_body(capsule, frames) for capsule in capsules}
    bodies |= {box.name: box_body(box) for box in boxes}
    pairs = [(*bodies[pair.part], *bodies[pair.other]) for pair in found.pairs]
    request, result = coal.DistanceRequest(), coal.DistanceResult()

    def distances() -> None:
        for pair in pairs:
            result.clear()
            coal.distance(*pair, request, result)

    return distances


def _circle(chain: SerialChain, ik: DifferentialIk, q: Array) -> tuple[float, float]:
    """Return the largest distance mm and angle deg of the setpoint from the exact path of the twists."""
    dt_s, rate = 1.0 / _RATE_HZ, 2 * np.pi / _LAP_S
    speed_m_s = rate * _DIAMETER_M / 2
    setpoint = JointSetpoint(chain, ik, _LIMITS)
    setpoint.reset(q)
    start = chain.forward(q)
    exact_m = start[:3, 3].copy()
    worst_m = worst_rad = 0.0
    for k in range(round(_LAP_S * _RATE_HZ)):
        angle = rate * k * dt_s
        setpoint.follow(speed_m_s * np.array([-np.sin(angle), np.cos(angle), 0.0, 0.0, 0.0, 0.0]), 1 << 62)
        setpoint.step(0, dt_s)
        exact_m += setpoint.twist[:3] * dt_s
        reached = chain.forward(setpoint.q)
        cosine = (np.trace(start[:3, :3].T @ reached[:3, :3]) - 1.0) / 2.0
        worst_m = max(worst_m, float(np.linalg.norm(reached[:3, 3] - exact_m)))
        worst_rad = max(worst_rad, float(np.arccos(min(cosine, 1.0))))
    return worst_m * 1e3, float(np.rad2deg(worst_rad))


def _reach_out(chain: SerialChain, ik: DifferentialIk, q: Array) -> tuple[float, float, float, float]:
    """Return fastest joint rad/s, smallest singular value m, path mm, and largest distance mm from the line."""
    start_m = chain.forward(q)[:3, 3]
    fastest, smallest_m, off_m = 0.0, np.inf, 0.0
    for _ in range(round(10 * _RATE_HZ)):
        motion = ik.solve(q, np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
        q = q + motion.dq / _RATE_HZ
        fastest = max(fastest, float(np.abs(motion.dq).max()))
        smallest_m = min(smallest_m, motion.smallest_singular_value)
        moved_m = chain.forward(q)[:3, 3] - start_m
        off_m = max(off_m, float(np.linalg.norm(moved_m[1:])))
    return fastest, smallest_m, float(moved_m[0]) * 1e3, off_m * 1e3
