"""``touchcell bench simulation``: accuracy and speed of the simulated scenes.

First, numbers of the dynamic scene against theory. Second, scripted contacts at every fidelity against MuJoCo at
0.1 ms. Third, whole cells in closed loop, dynamic ones commanded every 5 ms: simulated seconds per second of one core,
and its CPU time by part. Times are CPU times, not wall times, because cores are shared; other load still makes them
longer. ``--quick`` runs the first script and the first cell only, ``--mesh`` a cell on a mesh several times.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from benchmarks.cpu_shares import cpu_shares
from benchmarks.simulation_checks import Check, checks, quasi_static_yaw
from benchmarks.simulation_scripts import SCRIPTS, Script, Trace, perform
from touchcell.cell.bench.provenance import provenance
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.true_contact import put_on_true_contact
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Progress
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.geometry import se3
from touchcell.paths import CONFIGS
from touchcell.simulation.devices.tactip import SimTactip
from touchcell.simulation.scene import SceneConfig

_FINEST_MS = 0.1
_DYNAMIC_GRID_MS = 5.0
_MESH_REPETITIONS = 8
_CELLS = (
    "surface_follow_sim",
    "surface_mesh_sim",
    "object_track_sim",
    "single_push_sim",
    "dual_push_sim",
    "dual_push_tall_sim",
)
_MESHES: dict[str, dict[str, Any]] = {
    "surface_mesh_sim": {"saddle": {"kind": "mesh", "file": str(CONFIGS / "meshes" / "saddle.stl"), "unit": "mm"}}
}
"""Surfaces that take the place of a cell's own."""
_PARTS = {
    "touchcell/simulation/render": "images",
    "touchcell/simulation/tip.py": "images",
    "touchcell/simulation/devices/tactip": "images",
    "touchcell/simulation/arm_dynamics": "arms",
    "touchcell/simulation/devices/": "arms",
    "touchcell/drivers/core/joint_": "arms",
    "touchcell/drivers/kinematics/": "arms",
    "touchcell/simulation/kinematics": "arms",
    "touchcell/simulation/": "physics",
    "touchcell/perception/": "perception",
    "touchcell/control/": "control and interlocks",
    "touchcell/tasks/": "control and interlocks",
}


@dataclass(frozen=True, slots=True)
class _Fidelity:
    name: str
    physics: str
    physics_step_ms: float
    step_ms: float = 2.0
    joints: bool = False


_FIDELITIES = (
    _Fidelity("kinematic", "kinematic", 1.0),
    _Fidelity("quasi-static", "quasi_static", 1.0),
    _Fidelity("dynamic 2 ms", "dynamic", 2.0),
    _Fidelity("dynamic 1 ms", "dynamic", 1.0),
    _Fidelity("dynamic 1 ms, commanded every 5 ms", "dynamic", 1.0, _DYNAMIC_GRID_MS),
    _Fidelity("dynamic 1 ms, Pandas", "dynamic", 1.0, joints=True),
)


def run(arguments: Sequence[str], out: Path) -> None:
    """Print three tables; write ``simulation.json`` and ``simulation.png`` into ``out``."""
    parser = argparse.ArgumentParser(prog="touchcell bench simulation")
    parser.add_argument("--quick", action="store_true", help="the first script and the first cell only")
    parser.add_argument("--yaw", action="store_true", help="how blocks turn in quasi-static physics, and nothing else")
    parser.add_argument("--mesh", action="store_true", help="speed on a mesh without images, eight times, and no more")
    options = parser.parse_args(arguments)
    if options.yaw or options.mesh:
        (_yaw if options.yaw else _mesh)(out)
        return
    quick = options.quick
    scripts = dict(list(SCRIPTS.items())[: 1 if quick else None])
    checked = [] if quick else _check()
    fidelity = {name: _compare(name, script) for name, script in scripts.items()}
    print()
    speed = _speeds(quick=quick, out=out)
    result = {
        **provenance(),
        "checks": [asdict(each) for each in checked],
        "reference_step_ms": _FINEST_MS,
        "fidelity": fidelity,
        "speed": speed,
    }
    (out / "simulation.json").write_text(json.dumps(result, indent=1) + "\n")
    _plot(fidelity, speed, out / "simulation.png")


def _yaw(out: Path) -> None:
    found = quasi_static_yaw()
    lines = [f"{each.what:<72}{each.value:>32}  {each.aim:<12}{'' if each.passed else 'MISSED'}" for each in found]
    text = [f"{key}: {value}" for key, value in provenance().items()]
    (out / "simulation_yaw.txt").write_text("\n".join([*text, "", *lines]) + "\n")
    print("\n".join(lines))


def _mesh(out: Path) -> None:
    """Print simulated seconds per CPU second of a saddle followed as a mesh; write ``simulation_mesh.txt``."""
    (name,) = _MESHES
    data = yaml.safe_load(_cell_file(name).read_text())
    data["scene"]["surfaces"] = _MESHES[name]
    found = [
        float(_speed(data, "kinematic", images=False, out=out)["times_real_time"]) for _ in range(_MESH_REPETITIONS)
    ]
    about = "; ".join(f"{key} {value}" for key, value in provenance().items())
    lines = [
        f"touchcell bench simulation --mesh; {about}; load {os.getloadavg()[0]:.1f}",
        f"{name} on {Path(_MESHES[name]['saddle']['file']).name}, kinematic, without images: simulated s per CPU s",
        "runs:  " + "  ".join(f"{each:.1f}" for each in found),
        f"mean {np.mean(found):.1f}, median {np.median(found):.1f}, aim >= 20",
    ]
    (out / "simulation_mesh.txt").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def _check() -> list[Check]:
    found = checks()
    for each in found:
        print(f"{each.what:<72}{each.value:>12}  {each.aim:<12}{'' if each.passed else 'MISSED'}", flush=True)
    print()
    return found


def _compare(name: str, script: Script) -> dict[str, dict[str, float]]:
    print(f"{name:<34}{'tip rms um':>11}{'force rms mN':>13}{'object mm':>10}{'object deg':>11}{'x real time':>12}")
    finest = {joints: perform(script, "dynamic", _FINEST_MS, joints=joints) for joints in (False, True)}
    rows: dict[str, dict[str, float]] = {}
    for fidelity in _FIDELITIES:
        if not _offered(fidelity.physics, script.scene):
            continue
        on_grid = replace(script, scene={**script.scene, "step_ms": fidelity.step_ms})
        trace = perform(on_grid, fidelity.physics, fidelity.physics_step_ms, joints=fidelity.joints)
        rows[fidelity.name] = _errors(trace, finest[fidelity.joints])
    for joints, label in ((False, "dynamic 0.1 ms (reference)"), (True, "the same, Pandas (reference)")):
        rows[label] = {"times_real_time": finest[joints].duration_s / finest[joints].cpu_s}
    for label, row in rows.items():
        cells = [row.get(key) for key in ("tip_um", "force_mn", "object_mm", "object_deg", "times_real_time")]
        widths, digits = (11, 13, 10, 11, 12), (1, 1, 2, 2, 1)
        text = "".join(
            f"{'-' if cell is None else f'{cell:.{n}f}':>{width}}"
            for cell, width, n in zip(cells, widths, digits, strict=True)
        )
        print(f"  {label:<32}{text}", flush=True)
    return rows


def _offered(physics: str, scene: Mapping[str, Any]) -> bool:
    """Return True if this touchcell has such physics and supports such a scene."""
    if physics not in get_args(SceneConfig.model_fields["physics"].annotation):
        return False
    return physics == "dynamic" or (physics == "kinematic") == ("surfaces" in scene)


def _errors(trace: Trace, finest: Trace) -> dict[str, float]:
    shear_mm = np.linalg.norm(trace.shear_mm - finest.shear_mm, axis=-1)
    errors = {
        "tip_um": 1e3 * float(np.sqrt(np.mean(shear_mm**2))),
        "tip_max_um": 1e3 * float(shear_mm.max()),
        "force_mn": 1e3 * float(np.sqrt(np.mean((trace.force_n - finest.force_n) ** 2))),
        "times_real_time": trace.duration_s / trace.cpu_s,
    }
    for name, T_world_object in finest.objects.items():
        found = trace.objects[name]
        errors["object_mm"] = 1e3 * float(np.linalg.norm(found[:3, 3] - T_world_object[:3, 3]))
        turn = se3.log(se3.inverse(T_world_object) @ found)[3:]
        errors["object_deg"] = float(np.degrees(np.linalg.norm(turn)))
    return errors


def _speeds(*, quick: bool, out: Path) -> dict[str, dict[str, Any]]:
    names = [name for name in _CELLS if _cell_file(name).exists()][: 1 if quick else None]
    rows: dict[str, dict[str, Any]] = {}
    print(f"{'cell':<22}{'physics':<14}{'arms':<8}{'images':<8}{'x real time':>12}   share of the processor")
    for name in names:
        data = yaml.safe_load(_cell_file(name).read_text())
        data["scene"]["surfaces"] = _MESHES.get(name, data["scene"].get("surfaces", {}))
        offered = [physics for physics in ("kinematic", "quasi_static", "dynamic") if _fits(physics, data["scene"])]
        for physics in offered:
            for images in (False, True):
                row = _speed(data, physics, images=images, out=out)
                rows[f"{name}, {physics}, {'images' if images else 'no images'}"] = row
                shares = ", ".join(f"{part} {100 * share:.0f} %" for part, share in row["shares"].items())
                print(
                    f"{name:<22}{physics:<14}{len(data['arms']):<8}{'yes' if images else 'no':<8}"
                    f"{row['times_real_time']:12.1f}   {shares}; skipped: {', '.join(row['skipped'])}",
                    flush=True,
                )
    return rows


def _fits(physics: str, scene: Mapping[str, Any]) -> bool:
    return _offered(physics, {"surfaces": scene["surfaces"]} if scene.get("surfaces") else {"objects": {}})


def _cell_file(name: str) -> Path:
    return CONFIGS / f"{name}.yaml"


def _speed(cell_file: Mapping[str, Any], physics: str, *, images: bool, out: Path, longest_s: float = 10.0) -> Any:
    data = json.loads(json.dumps(cell_file))
    data["scene"]["physics"] = physics
    if physics == "dynamic":
        data["scene"]["step_ms"] = _DYNAMIC_GRID_MS
    if not images:
        put_on_true_contact(data)
        # Without images nobody can see a frozen one.
        data["interlocks"] = {key: item for key, item in data["interlocks"].items() if item["kind"] != "frame_frozen"}
    with tempfile.TemporaryDirectory(dir=out) as folder:
        path = Path(folder) / "cell.yaml"
        path.write_text(yaml.safe_dump(data))
        stop = StopRequest()

        def enough(progress: Progress) -> None:
            if progress.t_s > longest_s:
                stop.ask_at_once()

        cell = compose(plan_cell(path))
        with cell, cpu_shares(_PARTS, "loop") as counts:
            started = time.process_time()
            result = RunLoop(cell, None, stop=stop, on_cycle=enough).run()
            cpu_s = time.process_time() - started
        cameras = {name: camera for name, camera in cell.cameras.items() if isinstance(camera, SimTactip)}
        drawn = {name: camera.health()["frames_drawn"] for name, camera in cameras.items()}
    total = max(sum(counts.values()), 1)
    skipped = [] if images else ["images"]
    if all(arm["driver"] == "sim_arm" for arm in data["arms"].values()):
        skipped.append("arm dynamics")
    if physics != "dynamic":
        skipped.append("toppling and inertia" if physics == "quasi_static" else "everything that moves when touched")
    return {
        "outcome": result.outcome.value,
        "simulated_s": result.duration_s,
        "cpu_s": cpu_s,
        "times_real_time": result.duration_s / cpu_s,
        "shares": {part: count / total for part, count in counts.most_common()},
        "frames_drawn": drawn,
        "skipped": skipped,
    }


def _plot(fidelity: Mapping[str, Mapping[str, Mapping[str, float]]], speed: Mapping[str, Any], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(14, 5.5), layout="constrained")
    markers = dict(zip(fidelity, "osD^v", strict=False))
    colours = {each.name: f"C{index}" for index, each in enumerate(_FIDELITIES)}
    for script, rows in fidelity.items():
        for name, row in rows.items():
            if "tip_um" in row:
                left.scatter(row["times_real_time"], row["tip_um"], c=colours[name], marker=markers[script], s=60)
    handles = [plt.Line2D([], [], ls="", marker=marker, c="0.4", label=script) for script, marker in markers.items()]
    handles += [plt.Line2D([], [], ls="", marker="o", c=colour, label=name) for name, colour in colours.items()]
    left.legend(handles=handles, fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.12))
    left.set(xscale="log", yscale="log", xlabel="simulated seconds per second of one core")
    left.set_ylabel("RMS error of the tip's deflection against 0.1 ms (um)")
    left.axhline(100.0, c="0.6", ls="--")
    left.grid(alpha=0.3, which="both")
    names = list(speed)
    begin = np.zeros(len(names))
    for part in sorted({part for row in speed.values() for part in row["shares"]}):
        costs = [1e3 * speed[name]["shares"].get(part, 0.0) / speed[name]["times_real_time"] for name in names]
        right.barh(names, costs, left=begin, label=part)
        begin += costs
    for name, end in zip(names, begin, strict=True):
        right.text(end, name, f" {speed[name]['times_real_time']:.0f}x", va="center")
    right.set_xlabel("ms of one core per simulated second")
    right.invert_yaxis()
    right.legend(fontsize=8)
    right.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
