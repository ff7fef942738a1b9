"""``python -m benchmarks NAME [ARGUMENT ...]``: developer benchmarks that are not part of the wheel.

``touchcell bench NAME`` starts the same where touchcell is installed from a checkout.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

BENCHMARKS = {
    "adapt": "benchmarks.adapt",
    "against": "benchmarks.against",
    "armed": "benchmarks.armed",
    "calibration": "benchmarks.calibration",
    "emulated-push": "benchmarks.emulated_push",
    "executors": "benchmarks.executors",
    "false-trips": "benchmarks.false_trips",
    "faults": "tests.fault_injection.faults",
    "filter": "benchmarks.filter",
    "findings": "tests.fault_injection.findings",
    "fuzz-cells": "tests.fault_injection.fuzz_cells",
    "fuzz-recordings": "tests.fault_injection.fuzz_recordings",
    "gdn-vs-cnn": "benchmarks.gdn_vs_cnn",
    "jog": "benchmarks.jog",
    "keeper": "benchmarks.keeper",
    "live": "benchmarks.live",
    "mutation": "benchmarks.mutation",
    "hil-mutation": "benchmarks.hil_mutation",
    "hil-suites": "benchmarks.hil_suites",
    "perception-against": "benchmarks.perception_against",
    "phantom": "benchmarks.phantom",
    "pictures": "benchmarks.pictures",
    "pushes": "benchmarks.pushes",
    "recipe": "benchmarks.recipe",
    "recording": "benchmarks.recording",
    "kinematics": "benchmarks.kinematics",
    "safety": "tests.fault_injection.safety",
    "safety-against": "benchmarks.safety_against",
    "se3": "benchmarks.se3",
    "sessions": "benchmarks.sessions",
    "simulation": "benchmarks.simulation",
    "structure": "benchmarks.structure",
    "soak": "tests.fault_injection.soak",
    "steps": "benchmarks.steps",
    "tip-fem": "benchmarks.tip_fem",
    "tuning": "benchmarks.tuning",
    "cell-fixture": "benchmarks.cell_fixture",
    "world-faults": "benchmarks.world_faults",
}


def main() -> int:
    """Run one benchmark, with the arguments after its name."""
    parser = argparse.ArgumentParser("python -m benchmarks", description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("bench"), help="folder for tables and figures")
    parser.add_argument("name", choices=BENCHMARKS)
    parser.add_argument("rest", nargs=argparse.REMAINDER, help="passed on")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    importlib.import_module(BENCHMARKS[options.name]).run(options.rest, options.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
