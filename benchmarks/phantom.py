"""``touchcell bench phantom``: whether sensors that differ from what their model learnt feel contacts in free air.

In each of many rigs the shipped pushing cell has another tip and camera than its network was trained on: shifted by up
to 1 px, magnified by up to 1 %, tilted by up to 0.5 deg, with the default tip or the one fitted to real images. The
object stands farther away than usual, so that the arm approaches through free air. A phantom is a contact on which the
task acts before the tip touches. The same rigs without a zero frame show what the zero frame is for.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final
from unittest.mock import patch

from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.paths import CONFIGS
from touchcell.perception.runtime.contact_gate import ContactGate

_TRUTH: Final[dict[str, Any]] = {
    "sensors": {
        "sensor": {
            "tip": {"choice": ["default", "franka_tactip_1"]},
            "shift_px": [{"uniform": [-1, 1]}, {"uniform": [-1, 1]}],
            "zoom": {"uniform": [0.99, 1.01]},
            "camera_tilt_deg": [{"uniform": [-0.5, 0.5]}, {"uniform": [-0.5, 0.5]}],
        }
    }
}
_GAP_MM: Final = 20.0


@dataclass(frozen=True, slots=True)
class Rig:
    """Result of one rig.

    Attributes:
        seed: which one.
        outcome: ``touched``, ``phantom`` (the task acted before the tip touched), or how the run ended otherwise.
        depth_mm: true depth when the task took the contact for one; negative in free air.
    """

    seed: int
    outcome: str
    depth_mm: float


def run(arguments: Sequence[str], out: Path) -> None:
    """Print how many rigs felt phantoms, with and without a zero frame."""
    parser = argparse.ArgumentParser(prog="touchcell bench phantom")
    parser.add_argument("--rigs", type=int, default=200)
    options = parser.parse_args(arguments)
    out.mkdir(parents=True, exist_ok=True)
    result: dict[str, Any] = {"provenance": provenance(), "rigs": options.rigs}
    print(f"{options.rigs} rigs: tips, shift up to 1 px, zoom up to 1 %, camera tilt up to 0.5 deg")
    for name, zeroed in (("with a zero frame", True), ("without", False)):
        rigs = [try_rig(seed, zeroed=zeroed) for seed in range(options.rigs)]
        counts = {each: sum(rig.outcome == each for rig in rigs) for each in sorted({rig.outcome for rig in rigs})}
        depths = [rig.depth_mm for rig in rigs if rig.outcome == "touched"]
        print(f"  {name:<18} " + ", ".join(f"{count} {outcome}" for outcome, count in counts.items()), end="")
        print(f"; depth at touch {min(depths):.2f} to {max(depths):.2f} mm" if depths else "")
        result[name] = [asdict(rig) for rig in rigs]
    (out / "phantom.json").write_text(json.dumps(result, indent=1) + "\n")


def try_rig(seed: int, *, zeroed: bool = True) -> Rig:
    """Let one rig approach until the task has found a contact or has ended."""
    truth = {"sensors": {"sensor": dict(_TRUTH["sensors"]["sensor"])}}
    # The default tip has no file.
    if seed % 2:
        del truth["sensors"]["sensor"]["tip"]
    else:
        truth["sensors"]["sensor"]["tip"] = "franka_tactip_1"
    settings = {
        "truth": truth,
        "seed": seed,
        "scene.objects.prism.pose_mm_deg": [_GAP_MM, 3, 0, 0, 0, 0],
        "task.settle_timeout_s": 1.0,
    }
    if zeroed:
        return _tried(settings, seed)
    with patch.object(ContactGate, "take_zero", lambda gate, reduced: None):
        return _tried(settings, seed)


def _tried(settings: dict[str, Any], seed: int) -> Rig:
    cell = compose(plan_cell(CONFIGS / "single_push_sim.yaml", settings=settings))
    with cell:
        loop = RunLoop(cell, None)
        while loop.step():
            if cell.task.state not in ("prepare", "approach"):
                break
        state = cell.task.state
        assert cell.scene is not None
        contact = cell.scene.contact("sensor").value
        result = loop.end()
    depth_mm = 1e3 * contact.depth_m
    if state == "settle":
        return Rig(seed, "touched" if contact.in_contact else "phantom", depth_mm)
    return Rig(seed, f"{state}: {result.reason}"[:60], depth_mm)
