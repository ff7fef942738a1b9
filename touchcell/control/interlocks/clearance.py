"""Interlock that keeps arms clear of each other, of obstacles, and of themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from pydantic import PositiveFloat, model_validator

from touchcell.control.interlocks.boundary import REST_M_S
from touchcell.control.interlocks.collision import TOOL, Clearances, Pair
from touchcell.control.interlocks.coverage import (
    CannotTrip,
    CellFacts,
    Change,
    Fault,
    unchanged,
    with_arm,
    with_motion,
)
from touchcell.control.interlocks.planning_scene import Body, PlanningScene, SpatialInterlockConfig
from touchcell.control.interlocks.snapshot import CellView
from touchcell.control.interlocks.spec import InterlockSpec
from touchcell.control.interlocks.violation import Severity, Violation
from touchcell.drivers.core.samples import JointState, Stamped
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

_AHEAD_S = 0.01
_NEGLIGIBLE_M = 1e-7
_TRIED = 300
"""Poses of the cell among which two bodies that may collide are sought."""


@dataclass(frozen=True, slots=True, eq=False)
class Clearance:
    """Keep every arm at least ``limit_m`` from everything, and slow its approach to what is nearer than ``slow_m``.

        Motion that takes the two apart is allowed. What counts is where a command would lead within 10 ms; nearer than
    ``limit_m`` it has to take them apart faster than standing still, while they are not measured to close.
    """

    name: str
    severity: Severity
    bodies: Mapping[str, Body]
    clearances: Clearances
    limit_m: float
    slow_m: float

    def check(self, view: CellView) -> Violation | None:
        """Return a violation for the nearest pair that is too near and not separating."""
        apart = self.clearances.distances(self._frames(view, 0.0))
        if not np.min(apart, initial=np.inf) < self.slow_m:
            return None
        commanded = any(view.arms[role].command is not None for role in self.bodies)
        change = self.clearances.distances(self._frames(view, _AHEAD_S)) - apart if commanded else np.zeros_like(apart)
        wrong = (apart < self.slow_m) & (change < -_NEGLIGIBLE_M)
        if (too_near := apart < self.limit_m).any():
            measured = self.clearances.distances(self._frames(view, _AHEAD_S, measured=True)) - apart
            parting = (change >= REST_M_S * _AHEAD_S) & (measured > -2.0 * REST_M_S * _AHEAD_S)
            wrong |= too_near & ~parting
        if not wrong.any():
            return None
        nearest = int(np.argmin(np.where(wrong, apart, np.inf)))
        return self._violation(view, self.clearances.pairs[nearest], float(apart[nearest]))

    def _frames(self, view: CellView, ahead_s: float, *, measured: bool = False) -> Array:
        return np.concatenate(
            [body.frames(view.arms[role], ahead_s, measured=measured) for role, body in self.bodies.items()]
        )

    def _violation(self, view: CellView, pair: Pair, apart_m: float) -> Violation:
        too_near = apart_m < self.limit_m
        limit_m = self.limit_m if too_near else self.slow_m
        whose = "" if pair.other_arm is None else "its own " if pair.other_arm == pair.arm else f"{pair.other_arm}'s "
        what = "limit" if too_near else "slow below"
        return Violation(
            self.name,
            self.severity if too_near else Severity.LIMIT,
            pair.arm,
            f"{pair.part} is {1e3 * apart_m:.1f} mm from {whose}{pair.other}, {what} {1e3 * limit_m:g} mm",
            view.now_ns,
            value=apart_m,
            limit=limit_m,
            unit="m",
            escalates=False,
        )


class ClearanceConfig(SpatialInterlockConfig):
    """Smallest distance of every arm to the others, to the cell's ``obstacles:`` and to itself.

    Nearer than ``slow_mm``, approaching motion is slowed to a quarter for as long as it continues.

    Attributes:
        limit_mm: smallest distance.
        slow_mm: distance below which approaching motion is slowed to a quarter.
    """

    kind: Literal["clearance"]
    limit_mm: PositiveFloat
    slow_mm: PositiveFloat

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        if self.slow_mm < self.limit_mm:
            raise ValueError(f"slow_mm {self.slow_mm:g} is below limit_mm {self.limit_mm:g}")
        return self

    def faults(self, facts: CellFacts) -> Iterator[Fault | CannotTrip]:
        """Return each arm where something of it is too near to something else, if there is such a pose."""
        bodies = facts.scene.bodies
        for role in facts.arms.keys() - bodies.keys():
            yield CannotTrip(role, "its shape is not known", "kind", "give it a `body:`")
        if not bodies:
            return
        counts = {role: body.link_count + 2 for role, body in bodies.items()}
        clearances = Clearances({role: body.capsules for role, body in bodies.items()}, counts, facts.scene.boxes)
        near, apart = _search(clearances, facts, 1e-3 * self.limit_mm, 1e-3 * self.slow_mm)
        for role in bodies:
            if role in near:
                yield Fault(role, "too near", f"{self.limit_mm:g} mm", near[role], apart, key="limit_mm")
            else:
                reason = f"in none of {_TRIED} poses anything of it is nearer than {self.limit_mm:g} mm to anything"
                yield CannotTrip(role, reason, "limit_mm", "give it a `body:`, or name the `obstacles:` around it")

    def build_in_scene(self, name: str, T_tcp_sensor: Mapping[str, Array], planning_scene: PlanningScene) -> Clearance:
        """Return the ``Clearance`` interlock. Raises ConfigError if there are no two bodies that could collide."""
        bodies = planning_scene.bodies
        counts = {role: body.link_count + 2 for role, body in bodies.items()}
        clearances = Clearances({role: body.capsules for role, body in bodies.items()}, counts, planning_scene.boxes)
        if not clearances.pairs:
            raise ConfigError(
                "there are no two things to be kept apart",
                key=f"interlocks.{name}",
                hint="give the arms a `body:`, or name `obstacles:`",
            )
        return Clearance(name, self.level, bodies, clearances, 1e-3 * self.limit_mm, 1e-3 * self.slow_mm)


def _search(
    clearances: Clearances, facts: CellFacts, limit_m: float, slow_m: float
) -> tuple[dict[str, Change], Change]:
    """Return, for each arm, a pose of the cell in which it is too near to something, and one in which nothing is."""
    bodies = facts.scene.bodies
    rng = np.random.default_rng(0)
    places = _Places(facts)
    near: dict[str, Change] = {}
    apart: Change = unchanged
    widest_m = -math.inf
    for k in range(_TRIED):
        posed = _Posed({role: _random_pose(role, facts, places, k, rng) for role in bodies})
        view = posed(facts.healthy(0, ""), 0.0)
        frames = [body.frames(view.arms[role]) for role, body in bodies.items()]
        distances = clearances.distances(np.concatenate(frames))
        least_m = float(np.min(distances))
        if widest_m <= slow_m and least_m > widest_m:
            apart, widest_m = posed, least_m
        for pair, distance in zip(clearances.pairs, distances.tolist(), strict=True):
            if distance < limit_m:
                near.setdefault(pair.arm, posed)
                near.setdefault(pair.other_arm or pair.arm, posed)
        if widest_m > slow_m and len(near) == len(bodies):
            break
    return near, apart


@dataclass(frozen=True, slots=True, eq=False)
class _Posed:
    """A change to a pose of the whole cell: T_base_tcp (4, 4) and joint angles of each arm that has any."""

    poses: Mapping[str, tuple[Array, Array | None]]

    def __call__(self, view: CellView, t_s: float) -> CellView:
        for role, (T_base_tcp, q) in self.poses.items():
            view = with_motion(view, role, T_base_tcp)
            if q is not None:
                view = with_arm(view, role, joints=Stamped(JointState(q, np.zeros_like(q)), view.now_ns, 0))
        return view


class _Places:
    """Places in the world where an arm may meet something: where a box is nearest, where two arms reach, and bases."""

    def __init__(self, facts: CellFacts) -> None:
        self._boxes = facts.scene.boxes
        bases = {role: body.T_world_base[:3, 3] for role, body in facts.scene.bodies.items()}
        between = []
        for (one, first), (other, second) in itertools.combinations(bases.items(), 2):
            reach_m, other_m = facts.arms[one].reach_m, facts.arms[other].reach_m
            between.append(first + (second - first) * reach_m / (reach_m + other_m))
        self._points = [*between, *bases.values()]

    def __getitem__(self, number: int) -> Callable[[Array], Array]:
        """Return the place with that number, counted round and round, for an arm whose base is at a point (3,)."""
        k = number % (len(self._boxes) + len(self._points))
        if k >= len(self._boxes):
            return lambda base: self._points[k - len(self._boxes)]
        T, half_m = self._boxes[k].T_world_box, self._boxes[k].half_m

        def nearest(base: Array) -> Array:
            point: Array = T[:3, :3] @ np.clip(T[:3, :3].T @ (base - T[:3, 3]), -half_m, half_m) + T[:3, 3]
            return point

        return nearest


def _random_pose(
    role: str, facts: CellFacts, places: _Places, number: int, rng: np.random.Generator
) -> tuple[Array, Array | None]:
    """Return a pose of one arm: in turns anywhere within reach, and with a part of its tool where it may collide."""
    body = facts.scene.bodies[role]
    if (ik := body.kinematics()) is not None:
        q = rng.uniform(ik.chain.lower, ik.chain.upper)
        return ik.chain.forward(q), q
    reach_m = facts.arms[role].reach_m
    parts = [part.ends_m for part in body.capsules if part.frames == (TOOL, TOOL)]
    middle = np.mean(parts[number // 2 % len(parts)], axis=0) if parts else np.zeros(3)
    T_base_world = se3.inverse(body.T_world_base)
    there = T_base_world[:3, :3] @ places[number // 2](body.T_world_base[:3, 3]) + T_base_world[:3, 3]
    placed: Array = se3.exp(np.concatenate([np.zeros(3), rng.uniform(-math.pi, math.pi, 3)]))
    placed[:3, 3] = there - placed[:3, :3] @ middle
    if number % 2 or np.linalg.norm(placed[:3, 3]) > reach_m:
        placed[:3, 3] = rng.uniform(-reach_m, reach_m, 3)
    return placed, None


CLEARANCE = InterlockSpec("clearance", "arms keep clear of each other, obstacles and themselves", ClearanceConfig)
