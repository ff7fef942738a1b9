"""What running many trials costs besides the trials: this checkout beside an earlier one, on the same cells.

The CPU time of all processes over that of the trials alone does not depend on what else the machine does. Nor, nearly,
does the time of the cores that others have left, used or not, over the CPU time of the trials: on an otherwise idle
machine that is the wall-clock time times the number of cores.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.other_load import Usage

_SCRIPT = """
import sys, time
from pathlib import Path

{imports}

def measure(folder):
    return {{"size": float((folder.path / "run.mcap").stat().st_size)}}

class Timed(Perform):
    def __call__(self, trial):
        started = time.process_time()
        finished = super().__call__(trial)
        (self.root / trial.name / "trial_cpu_s").write_text(str(time.process_time() - started))
        return finished

if __name__ == "__main__":
    root, count, jobs = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    trials = [Trial(f"{{seed:04}}", "all", "surface_follow_sim.yaml", {{"seed": seed}}) for seed in range(1, count + 1)]
    finished = perform_all(Timed(measure, root), trials, {jobs})
    assert all(each.done for each in finished), [each.reason for each in finished]
"""
_NOW = """from touchcell.cell.experiments.executors import Workers
from touchcell.cell.experiments.run_trials import perform_all
from touchcell.cell.experiments.trials import Perform, Trial"""
_EARLIER = "from cell.trials import Perform, Trial, perform_all"


@dataclass(frozen=True, slots=True)
class SweepCost:
    """The cost of one sweep.

    Attributes:
        trials: how many.
        wall_s: from the start of the command to its end.
        cpu_s: of all its processes.
        trials_cpu_s: of the trials alone.
        others_cores: cores that other processes used meanwhile.
        cpu_ratio: ``cpu_s`` over ``trials_cpu_s``.
        left_ratio: time of the cores that others left, over ``trials_cpu_s``.
        wall_ratio: wall-clock time of all cores, over ``trials_cpu_s``.
    """

    trials: int
    wall_s: float
    cpu_s: float
    trials_cpu_s: float
    others_cores: float
    cpu_ratio: float
    left_ratio: float
    wall_ratio: float


def sweep_cost(checkout: Path | None, trials: int, jobs: int) -> SweepCost:
    """Run a sweep of this checkout, or of an earlier one with a .venv of its own."""
    if checkout is None:
        python, imports, options = sys.executable, _NOW, "workers=Workers(jobs, 3600.0)"
    else:
        python, imports, options = str(checkout.absolute() / ".venv/bin/python"), _EARLIER, "jobs=jobs"
    with tempfile.TemporaryDirectory() as name:
        script, root = Path(name, "sweep.py"), Path(name, "trials")
        root.mkdir()
        script.write_text(_SCRIPT.format(imports=imports, jobs=options))
        environment = os.environ if checkout is None else {**os.environ, "PYTHONPATH": str(checkout.absolute())}
        started = Usage.now()
        command = [python, str(script), str(root), str(trials), str(jobs)]
        subprocess.run(command, check=True, cwd=name, env=environment, stdout=subprocess.DEVNULL)
        used = Usage.now() - started
        each = [float(path.read_text()) for path in root.glob("*/trial_cpu_s")]
    assert len(each) == trials, f"{len(each)} of {trials} trials"
    of_trials = sum(each)
    return SweepCost(
        trials,
        used.wall_s,
        used.ours_s,
        of_trials,
        used.others_cores,
        used.ours_s / of_trials,
        used.left_s / of_trials,
        used.wall_s * (os.cpu_count() or 1) / of_trials,
    )


def sweep_costs(checkout: Path | None, trials: int, jobs: int, rounds: int) -> dict[str, list[dict[str, float]]]:
    """Return the costs of ``rounds`` sweeps in turn, by "now" and "earlier"."""
    found: dict[str, list[dict[str, float]]] = {"now": []} if checkout is None else {"now": [], "earlier": []}
    for _ in range(rounds):
        for name in found:
            found[name].append(asdict(sweep_cost(None if name == "now" else checkout, trials, jobs)))
    return found
