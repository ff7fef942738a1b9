"""The cells of the findings: shipped cells with one fault each, of whatever version ``shipped`` reads.

Nothing of touchcell is imported, so that an earlier version can be given the same cells.
"""

from __future__ import annotations

import copy
import gzip
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

Cell = Mapping[str, Any] | str | bytes
Shipped = Callable[[str], dict[str, Any]]
"""Reads a shipped cell by its name."""

PUSH = "dual_push_sim"
FOLLOW = "surface_follow_sim"


def changed(data: dict[str, Any], key: str, value: Any) -> dict[str, Any]:
    """A copy of ``data`` with ``value`` at a dotted key; None removes it."""
    cell = copy.deepcopy(data)
    *path, last = key.split(".")
    inner = cell
    for part in path:
        inner = inner[part]
    if value is None:
        inner.pop(last, None)
    else:
        inner[last] = value
    return cell


def on_true_contact(data: dict[str, Any]) -> dict[str, Any]:
    """A copy whose sensors give the simulator's truth, without the interlocks that need a network."""
    cell = copy.deepcopy(data)
    for sensor in cell["sensors"].values():
        sensor["estimator"] = {"kind": "true_contact"}
    kinds = ("uncertain", "out_of_range", "inconsistent", "exposure", "frame_frozen", "markers_lost")
    cell["interlocks"] = {name: entry for name, entry in cell["interlocks"].items() if entry["kind"] not in kinds}
    return cell


def unbounded(shipped: Shipped) -> dict[str, Cell]:
    """S1: a moved arm without bounds of its own, or with bounds out of reason."""
    both, one = shipped(PUSH), shipped(FOLLOW)
    return {
        "no box for the follower": changed(both, "interlocks.follower_box", None),
        "the other arm's sensor": changed(both, "interlocks.leader_box.sensor", "follower_sensor"),
        "a box of 2 km": changed(
            changed(one, "interlocks.workspace.max_mm", [1e6] * 3), "interlocks.workspace.min_mm", [-1e6] * 3
        ),
        "100 m/s": changed(one, "interlocks.tcp_speed.limit_m_s", 100),
        "frames of 1e9 ms": changed(one, "interlocks.stale_frame.limit_ms", 1e9),
        "depth 500 mm": changed(one, "interlocks.indentation.limit_mm", 500),
        "no margin": changed(one, "interlocks.workspace.margin_mm", None),
    }


def inactive(shipped: Shipped) -> dict[str, Cell]:
    """S2: interlocks that can never trip."""
    both, one = shipped(PUSH), shipped(FOLLOW)
    unfiltered = changed(one, "sensors.sensor.estimator.filter", None)
    unfiltered["interlocks"]["inconsistent"] = {"kind": "inconsistent", "limit_nis": 22.5, "frames": 5}
    step = {"kind": "out_of_step", "limit_mm_s": 30, "limit_mm": 4, "hold_ms": 100, "leader": "ledaer"}
    lost = {"kind": "contact_lost", "limit_ms": 500, "states": ["setle", "rnu"]}
    unsure = {"kind": "uncertain", "limit_mm": 1}
    alone = {**step, "leader": "leader", "follower_sensor": "leader_sensor", "follower": "leader"}
    lean = {"kind": "toppling", "limit_deg": 10, "limit_deg_s": 30, "limit_mm": 4, "hold_ms": 100, "arms": ["a", "b"]}
    return {
        "states: [setle, rnu]": changed(one, "interlocks.lost", lost),
        "leader: ledaer": changed(both, "interlocks.step", step),
        "inconsistent without a filter": unfiltered,
        "uncertain on true contact": changed(on_true_contact(one), "interlocks.sure", unsure),
        "exposure on true contact": changed(
            on_true_contact(one), "interlocks.light", {"kind": "exposure", "limit_percent": 15}
        ),
        "out_of_range on true contact": changed(
            on_true_contact(one), "interlocks.range", {"kind": "out_of_range", "limit_ms": 300}
        ),
        "markers_lost with a gdn": changed(
            one, "interlocks.markers", {"kind": "markers_lost", "limit_percent": 10, "frames": 3}
        ),
        "out_of_step of one sensor": changed(both, "interlocks.step", alone),
        "toppling with arms [a, b]": changed(both, "interlocks.lean", lean),
    }


def too_deep(shipped: Shipped) -> dict[str, Cell]:
    """S3: a depth limit beyond what the network was taught."""
    return {"9 mm, taught to 7.3": changed(shipped(FOLLOW), "interlocks.indentation.limit_mm", 9)}


def badly_named(shipped: Shipped) -> dict[str, Cell]:
    """a4: names that leave the folder of runs."""
    return {repr(name)[:20]: shipped(FOLLOW) | {"name": name} for name in ("../../evil", "", "x" * 400, "a/b", "..")}


def without_model(shipped: Shipped) -> dict[str, Cell]:
    """a5: models that are not there, or are none."""
    key = "sensors.sensor.estimator.model"
    return {
        model: changed(shipped(FOLLOW), key, model)
        for model in ("builtin:sim_gnd", "none.safetensors", ".", "cell.yaml")
    }


def doomed(shipped: Shipped) -> dict[str, Cell]:
    """a8: what `run` refuses or trips on."""
    one = shipped(FOLLOW)
    return {
        "sensor: sensr": changed(one, "interlocks.workspace.sensor", "sensr"),
        "no model": changed(one, "sensors.sensor.estimator.model", "none.safetensors"),
        "a folder as model": changed(one, "sensors.sensor.estimator.model", "."),
        "text as model": changed(one, "sensors.sensor.estimator.model", "cell.yaml"),
        "no scene": changed(one, "scene", None),
        "empty scene": changed(one, "scene", {}),
        "gate reversed": changed(one, "sensors.sensor.estimator.gate", {"touch_percent": 2.5, "release_percent": 4}),
        "depth 8 of 6": changed(one, "task.depth_mm", 8),
        "500 mm/s": changed(one, "task.speed_mm_s", 500),
        "start outside": changed(one, "arms.arm.start_pose_mm_deg", [-800, 0, 25, 180, 0, 0]),
        "1e30 mm": changed(one, "task.distance_mm", 1e30),
        "no calibration": changed(one, "sensors.sensor.estimator.calibration", "none.yaml"),
        "rate_hz: yes": yaml.safe_dump(changed(one, "rate_hz", 1)).replace("rate_hz: 1\n", "rate_hz: yes\n"),
        "seed: 1:30": yaml.safe_dump(changed(one, "seed", 7)).replace("seed: 7\n", "seed: 1:30\n"),
    }


def badly_answered(shipped: Shipped, text: str) -> list[tuple[Cell, str]]:
    """a9: cells, and what the message has to say of each. ``text`` is that of the shipped FOLLOW."""
    one = shipped(FOLLOW)
    return [
        (changed(one, "arms.arm.start_pose_mm_deg", [1, 2, 3, 4, 5]), "needs six numbers"),
        (changed(one, "schema", None), "(add `schema: 1`)"),
        (one | {"schma": 1}, "did you mean 'schema'"),
        (changed(one, "interlocks.workspace.min_mm", [0, 0, 500]), " interlocks.workspace: min_mm"),
        (changed(one, "scene.surfaces.ramp.kind", "rampp"), "did you mean 'ramp'"),
        (changed(one, "interlocks.indentation.kind", "deptth"), "did you mean 'depth'"),
        (text.replace("    driver: sim_arm", "\tdriver: sim_arm"), "use spaces"),
        (changed(one, "arms.arm.driver", "sim_tactip"), "not an arm"),
    ]


def _bomb() -> bytes:
    rows = [b"%c: &%c [%s]" % (i, i, b", ".join([b"*%c" % (i - 1)] * 9)) for i in b"bcdefghij"]
    return b"\n".join([b"a: &a [x]", *rows])


def broken_commands(folder: Path, good: Path) -> dict[str, list[object]]:
    """a7: command lines that are wrong, with their files in ``folder``; ``good`` is a cell that runs."""
    files: dict[str, bytes] = {
        "binary": bytes(range(256)),
        "gzip": gzip.compress(b"schema: 1"),
        "latin-1": "name: ä".encode("latin-1"),
        "UTF-16": "name: x".encode("utf-16"),
        "self": b"loop: &a [*a]",
        "key": b"? [a, b]\n: c",
        "bomb": _bomb(),
    }
    for name, content in files.items():
        (folder / f"{name}.yaml").write_bytes(content)
    (folder / "file").touch()
    commands: dict[str, list[object]] = {name: ["check", folder / f"{name}.yaml"] for name in files}
    return commands | {
        "--out a file": ["run", good, "--out", folder / "file", "--quiet"],
        "--out no parent": ["run", good, "--out", folder / "file" / "x", "--quiet"],
        "--port 80000": ["ui", folder, "--port", 80000],
        "--port -5": ["ui", folder, "--port", -5],
        "--jobs -3": ["experiment", "surface_following", "--jobs", -3, "--quick"],
        "--trials -1": ["experiment", "surface_following", "--trials", -1],
        "emulate no file": ["emulate", "cell", folder / "none.yaml"],
        "emulate a simulated cell": ["emulate", "cell", good],
        "emulate --host 8.8.8.8": ["emulate", "ur", "--host", "8.8.8.8"],
    }


def over_nothing(shipped: Shipped) -> dict[str, Any]:
    """A cell whose approach ends without a contact: the task fails."""
    return changed(_swaying(shipped), "arms.arm.start_pose_mm_deg", [-80, 0, 120, 180, 0, 0])


def tripping(shipped: Shipped) -> dict[str, Any]:
    """A cell that leaves its box soon."""
    short = changed(_swaying(shipped), "task.distance_mm", 30)
    return changed(short, "interlocks.workspace.max_mm", [-72, 50, 150])


def _swaying(shipped: Shipped) -> dict[str, Any]:
    """A cell whose surface moves, if only by a micrometre: what its run comes to is not known before."""
    sway = {"kind": "periodic", "amplitude_mm_deg": [0, 0, 0.001, 0, 0, 0], "period_s": 10}
    return changed(on_true_contact(shipped(FOLLOW)), "scene.surfaces.ramp.motion", sway)


def safety_example(shipped: Shipped, page: str) -> dict[str, Any]:
    """a6: the example of the safety page, pasted into the shipped cell."""
    block = next(part for part in page.split("```yaml\n")[1:] if "clear:" in part).partition("```")[0]
    data, example = on_true_contact(shipped(PUSH)), yaml.safe_load(block)
    for section in ("arms", "interlocks"):
        for name, entry in example.get(section, {}).items():
            data[section][name] = data[section].get(name, {}) | entry
    data["obstacles"] = example["obstacles"]
    for key, value in example.get("task", {}).items():
        data["task"][key] = data["task"].get(key, {}) | value if isinstance(value, dict) else value
    return data


def odd_twists() -> dict[str, Any]:
    """R8b: what a caller may take for a twist."""
    import numpy as np

    return {
        "list": [0.005, 0, 0, 0, 0, 0],
        "float32": np.zeros(6, np.float32),
        "integers": np.zeros(6, int),
        "text": np.array(["0"] * 6),
        "objects": np.array([None] * 6),
        "complex": np.zeros(6, complex),
        "booleans": np.zeros(6, bool),
        "None": None,
        "ragged": [[0.0], 0.0, 0.0, 0.0, 0.0, 0.0],
        "five": np.zeros(5),
    }


def ways_back() -> list[tuple[str, list[float], list[float]]]:
    """R8c: name, commanded and measured twist of an arm that is far outside along x."""
    still = [0.0] * 6
    return [
        ("-1e-9 m/s", [-1e-9, 0, 0, 0, 0, 0], still),
        ("-0.1 m/s with 5 m/s sideways", [-0.1, 5.0, 0, 0, 0, 0], still),
        ("commanded back, measured outwards", [-0.1, 0, 0, 0, 0, 0], [0.1, 0, 0, 0, 0, 0]),
    ]
