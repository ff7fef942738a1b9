"""Single-arm pushing (paper 5.6): four prisms over two surfaces to a target, five trials each."""

from __future__ import annotations

from touchcell.cell.experiments.pushing import ONE_ARM, PRISMS, prism_experiment

SPEC = prism_experiment(
    "single_arm_pushing",
    "one arm pushes four prisms over two surfaces 300 mm to a target",
    ONE_ARM,
    {pushed.name: "< 10 mm" if pushed.name == "circular" else "< 5 mm" for pushed in PRISMS},
)
