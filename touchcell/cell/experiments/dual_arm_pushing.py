"""Dual-arm pushing (paper 5.7.1): the same prisms, surfaces and target, with a follower that steadies the far side."""

from __future__ import annotations

from touchcell.cell.experiments.pushing import PRISMS, TWO_ARMS, prism_experiment

SPEC = prism_experiment(
    "dual_arm_pushing",
    "two arms push four prisms over two surfaces 300 mm to a target",
    TWO_ARMS,
    {pushed.name: "< 5 mm" for pushed in PRISMS},
)
