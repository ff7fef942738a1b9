"""What the arms of a cell look like and what stands around them, from the cell file and the arms' chains."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from touchcell.control.interlocks.clearance import ClearanceConfig
from touchcell.control.interlocks.collision import BASE, TOOL, Box, Capsule
from touchcell.control.interlocks.planning_scene import Body, PlanningScene
from touchcell.drivers.core.protocols import ServoArm, TwistSink
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array

if TYPE_CHECKING:
    from touchcell.cell.config.cell_plan import ArmSection, BoxSection, CapsuleSection, CellPlan
    from touchcell.drivers.kinematics.chain import CapsuleShape, ChainDescription, DifferentialIk


def build_planning_scene(plan: CellPlan, arms: Mapping[str, Any], names: Mapping[str, str]) -> PlanningScene:
    """Where the arms of a cell stand, and what they look like if it has a ``clearance``.

    Args:
        plan: a checked cell file.
        arms: devices by role.
        names: of each in the cell file, by role.

    Raises:
        ConfigError: an arm has no capsule at all.
    """
    sections = {role: plan.cell.arms[names[role]] for role in arms}
    placed = {role: each.T_world_base for role, each in sections.items()}
    if not any(isinstance(entry, ClearanceConfig) for entry in plan.cell.interlocks.values()):
        return PlanningScene(placed)
    bodies = {
        role: _body(sections[role], placed[role], cast(ServoArm, arm))
        for role, arm in arms.items()
        if isinstance(arm, TwistSink)
    }
    return PlanningScene(placed, bodies, [_box(name, section) for name, section in plan.cell.obstacles.items()])


def planned_scene(plan: CellPlan, role_of: Mapping[str, str]) -> PlanningScene:
    """The same before any device is built: links are those of the chains that the configurations name.

    Args:
        plan: a checked cell file.
        role_of: role of each arm by its name in the cell file.

    Raises:
        ConfigError: an arm has no capsule at all, or a chain file cannot be read.
    """
    placed = {role: plan.cell.arms[name].T_world_base for name, role in role_of.items()}
    if not any(isinstance(entry, ClearanceConfig) for entry in plan.cell.interlocks.values()):
        return PlanningScene(placed)
    from touchcell.drivers.kinematics.chain import DifferentialIk

    bodies = {}
    for name, role in role_of.items():
        if TwistSink in plan.arms[name].spec.capabilities.provides:
            chain = plan.arms[name].config.described_chain()
            ik = None if chain is None else DifferentialIk(chain)
            bodies[role] = _shape(plan.cell.arms[name], placed[role], name, partial(_same, ik))
    return PlanningScene(placed, bodies, [_box(name, section) for name, section in plan.cell.obstacles.items()])


def _same(ik: DifferentialIk | None) -> DifferentialIk | None:
    return ik


def _body(section: ArmSection, T_world_base: Array, arm: ServoArm) -> Body:
    return _shape(section, T_world_base, arm.name, arm.kinematics)


def _shape(
    section: ArmSection, T_world_base: Array, name: str, kinematics: Callable[[], DifferentialIk | None]
) -> Body:
    parts = [_part(k, part) for k, part in enumerate(section.body)]
    ik = kinematics()
    links = [] if ik is None else link_capsules(ik.chain.description)
    if not links:
        if not parts:
            raise ConfigError(
                "nobody knows what this arm looks like",
                key=f"arms.{name}.body",
                hint="name capsules here, or in its chain file",
            )
        return Body(T_world_base, parts)
    assert ik is not None
    return Body(T_world_base, links + parts, kinematics, ik.chain.joint_count)


def link_capsules(description: ChainDescription) -> list[Capsule]:
    """The capsules of an arm's base and links, as its chain file has them."""
    found = [_capsule("its base", BASE, shape) for shape in description.base_capsules]
    for k, joint in enumerate(description.joints, start=1):
        found += [_capsule(f"the link at {joint.name}", k, shape) for shape in joint.capsules]
    return found


def _capsule(name: str, frame: int, shape: CapsuleShape) -> Capsule:
    return Capsule(name, (frame, frame), (_metres(shape.from_mm), _metres(shape.to_mm)), 1e-3 * shape.radius_mm)


def _part(number: int, part: CapsuleSection) -> Capsule:
    start = part.from_mm if part.from_base_mm is None else part.from_base_mm
    assert start is not None
    frames = (TOOL if part.from_base_mm is None else BASE, TOOL)
    return Capsule(f"body[{number}]", frames, (_metres(start), _metres(part.to_mm)), 1e-3 * part.radius_mm)


def _box(name: str, section: BoxSection) -> Box:
    half_m: Array = 0.5e-3 * np.array(section.size_mm)
    return Box(name, se3.from_euler_mm_deg(np.array(section.pose_mm_deg)), half_m)


def _metres(place_mm: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = place_mm
    return 1e-3 * x, 1e-3 * y, 1e-3 * z
