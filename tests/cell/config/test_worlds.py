"""One cell file in three worlds: what each puts in place of what, and what it refuses."""

from __future__ import annotations

import os
import pty
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from touchcell.cell.config.addresses import clashes
from touchcell.cell.config.layers import explain, load_layers
from touchcell.cell.config.schema import EMULATED_CAMERAS, plan_cell, plan_in_world
from touchcell.cell.config.worlds import WorldName
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.cell.runtime.bench_lock import addresses
from touchcell.drivers.core.bench_address import is_pseudo_terminal, is_virtual_can
from touchcell.drivers.core.spec import DRIVERS
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

BENCH = CONFIGS / "surface_follow_bench.yaml"
CELLS = sorted(path.name for path in CONFIGS.glob("*_bench.yaml"))


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    path = tmp_path / "bench.yaml"
    path.write_text(BENCH.read_text())
    return path


@pytest.mark.parametrize("host", ["127.0.0.2", "localhost", "::1", "0.0.0.0"])
def test_an_emulators_address_is_refused_on_the_bench_by_its_key(bench: Path, host: str) -> None:
    with pytest.raises(ConfigError, match="leads to an emulator") as caught:
        plan_in_world(bench, "bench", settings={"arms.arm.host": host})
    assert caught.value.key == "arms.arm.host"
    assert plan_in_world(bench, None, settings={"arms.arm.host": host}).arms


def test_virtual_buses_and_pseudo_terminals_lead_to_no_device_of_a_bench() -> None:
    near, far = pty.openpty()
    try:
        assert is_pseudo_terminal(os.ttyname(far))
    finally:
        os.close(near)
        os.close(far)
    assert not is_pseudo_terminal("/dev/serial/by-id/usb-adapter")
    assert is_virtual_can("socketcan", "vcan0")
    assert is_virtual_can("touchcell_hub", "/run/hub")
    assert not is_virtual_can("socketcan", "can0")
    assert not is_virtual_can("slcan", "/dev/ttyACM0")


def test_a_cell_that_feels_edges_gets_a_disc_and_the_network_of_simulated_edges(tmp_path: Path) -> None:
    cell = tmp_path / "cell.yaml"
    cell.write_text((CONFIGS / "edge_follow_bench.yaml").read_text().replace("builtin:sim_edge", "mine.safetensors"))
    (tmp_path / "mine.safetensors").write_bytes(
        (CONFIGS.parent / "perception/models/sim_edge.safetensors").read_bytes()
    )
    plan = plan_in_world(cell, "sim")
    assert plan.cell.sensors["sensor"].estimator.model == "builtin:sim_edge"
    assert plan.cell.scene["feels"] == "shape"
    assert [each["kind"] for each in plan.cell.scene["surfaces"].values()] == ["cylinder"]


@pytest.mark.parametrize("cell", CELLS)
def test_every_shipped_bench_cell_can_be_simulated_with_its_drivers_own_abilities(cell: str) -> None:
    plan = plan_in_world(CONFIGS / cell, "sim")
    assert plan.cell.time == "simulated"
    for device in plan.built.values():
        real = DRIVERS.load(device.spec.name).capabilities
        able = device.spec.capabilities
        assert able.virtual_time
        assert (able.provides, able.stop_categories, able.twist_axes) == (
            real.provides,
            real.stop_categories,
            real.twist_axes,
        )
        assert able.command_latency_s == real.command_latency_s


def test_what_a_world_changes_is_explained_as_its_own(bench: Path) -> None:
    plan = plan_in_world(bench, "sim", settings={"task.depth_mm": 2})
    text = explain(load_layers(bench, plan.settings, plan.world_settings))
    rows = {row.split(":")[0].strip(): row for row in text.splitlines()}
    assert rows["time"].endswith("# --on sim")
    assert rows["depth_mm"].endswith("# --set")
    assert rows["host"].split("#")[1].strip().startswith(f"{bench}:")
    assert any("default for surface_following" in note for note in plan.notes)


def test_the_file_of_a_simulated_run_plans_as_it_ran(bench: Path, tmp_path: Path) -> None:
    plan = plan_in_world(bench, "sim")
    copy = tmp_path / "copy.yaml"
    copy.write_text(plan.text())
    again = plan_cell(copy, to_run=False)
    assert again.cell == plan.cell
    assert again.arms["arm"].spec.capabilities.virtual_time


@pytest.mark.parametrize("cell", ["surface_follow_sim.yaml", "dual_push_sim.yaml"])
def test_nothing_simulated_is_on_a_bench(cell: str) -> None:
    with pytest.raises(ConfigError) as caught:
        plan_in_world(CONFIGS / cell, "bench")
    assert "is no device of a bench" in str(caught.value)
    assert caught.value.key.endswith(".driver")


def test_emulated_cameras_are_refused_on_a_bench(bench: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert plan_in_world(bench, "bench").cell.world == "bench"
    monkeypatch.setenv(EMULATED_CAMERAS, "/tmp/cameras")
    with pytest.raises(ConfigError, match="emulated cameras"):
        plan_in_world(bench, "bench")


def test_a_simulated_cell_has_no_emulators() -> None:
    with pytest.raises(ConfigError, match="simulated already"):
        plan_in_world(CONFIGS / "surface_follow_sim.yaml", "emulated")


def test_settings_go_before_the_world(bench: Path) -> None:
    pose = [480, -150, 400, 180, 0, 0]
    plan = plan_in_world(bench, "sim", settings={"arms.arm.start_pose_mm_deg": pose})
    assert plan.cell.arms["arm"].start_pose_mm_deg == tuple(pose)
    surfaces = plan.cell.model_dump()["scene"]["surfaces"]
    # The tip starts 5 mm in front of the default plate.
    assert surfaces["sensor_plate"]["pose_mm_deg"][2] == pytest.approx(400 - 25)


def test_a_start_pose_out_of_reach_is_named(bench: Path) -> None:
    with pytest.raises(ConfigError, match="no joint angles reach") as caught:
        plan_in_world(bench, "sim", settings={"arms.arm.start_pose_mm_deg": [3000, 0, 0, 180, 0, 0]})
    assert caught.value.key == "arms.arm.start_pose_mm_deg"


def test_a_scene_beside_the_file_is_used(bench: Path) -> None:
    scene = {"surfaces": {"dome": {"kind": "dome", "radius_mm": 80, "pose_mm_deg": [490, -150, 300, 0, 0, 0]}}}
    bench.with_name("bench.scene.yaml").write_text(
        yaml.safe_dump({"start_pose_mm_deg": {"arm": [490, -150, 405, 180, 0, 0]}, **scene})
    )
    plan = plan_in_world(bench, "sim")
    assert plan.cell.scene is not None
    assert list(plan.cell.scene["surfaces"]) == ["dome"]
    start = plan.cell.arms["arm"].start_pose_mm_deg
    assert start is not None
    assert np.allclose(start[:3], [490, -150, 405])


def test_labels_and_models_of_the_bench_are_not_mixed_with_simulated_ones(bench: Path, tmp_path: Path) -> None:
    plan = plan_in_world(CONFIGS / "collect_bench.yaml", "sim")
    assert plan.cell.collect is not None
    assert str(plan.cell.collect.data).endswith("collected-sim")
    (tmp_path / "mine.safetensors").write_bytes((CONFIGS.parent / "perception/models/sim_gdn.safetensors").read_bytes())
    model = {"sensors.sensor.estimator.model": str(tmp_path / "mine.safetensors")}
    data = yaml.safe_load(bench.read_text())
    data["sensors"]["sensor"]["estimator"]["model"] = "mine.safetensors"
    bench.write_text(yaml.safe_dump(data))
    simulated = plan_in_world(bench, "sim")
    assert "sensors.sensor.estimator.model" in simulated.world_settings
    assert any("mine.safetensors" in note for note in simulated.notes)
    assert plan_in_world(bench, "sim", settings=model).settings == model


def test_a_driver_without_behaviour_is_named_where_it_would_be_simulated(
    bench: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from dataclasses import replace

    real = DRIVERS.load("ur")
    monkeypatch.setattr("touchcell.drivers.ur.driver.SPEC", replace(real, behaviour=None))
    with pytest.raises(ConfigError, match="does not describe how its device behaves"):
        plan_in_world(bench, "sim", settings={"arms.arm.start_pose_mm_deg": [490, -150, 400, 180, 0, 0]})


PLATE = "surfaces: {part: {kind: mesh, file: %s, unit: mm, pose_mm_deg: [490, -150, 360, 0, 0, 0]}}\n"


@pytest.mark.parametrize("world", ["sim", "emulated"])
@pytest.mark.parametrize("key", ["scene", "emulated_scene", None])
def test_files_of_a_scene_are_relative_to_the_file_that_names_them_in_every_world(
    bench: Path, tmp_path: Path, world: WorldName, key: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "cells").mkdir()
    (tmp_path / "cells" / "part.stl").write_bytes((CONFIGS / "meshes" / "hill.stl").read_bytes())
    cell = tmp_path / "cells" / "mine.yaml"
    own = "" if key is None else f"{key}:\n  {PLATE % 'part.stl'}"
    cell.write_text(f"extends: ../bench.yaml\nname: mine\n{own}")
    if key is None:
        cell.with_name("mine.scene.yaml").write_text(PLATE % "part.stl")
    monkeypatch.chdir("/")
    planned = plan_in_world(cell, world).cell
    scene = planned.scene if world == "sim" else planned.emulated_scene
    assert scene is not None
    assert scene["surfaces"]["part"]["file"] == str(tmp_path / "cells" / "part.stl")


@pytest.mark.parametrize(
    ("text", "line", "key", "words"),
    [
        (PLATE % "gone.stl", 1, "surfaces.part.file", "no such file"),
        ("step_ms: 5\nsurfaces: {part: {kind: plain}}\n", 2, "surfaces.part.kind", "plain"),
        ("start_pose_mm_deg: {arn: [0, 0, 0, 0, 0, 0]}\n", 1, "start_pose_mm_deg.arn", "no arm"),
        ("start_pose_mm_deg:\n  arm: [1, 2, 3]\n", 2, "start_pose_mm_deg.arm", "six numbers"),
        ("start_pose_mm_deg: {arm: [3000, 0, 0, 0, 0, 0]}\n", 0, "start_pose_mm_deg.arm", "start pose [3000.0,"),
    ],
)
def test_a_mistake_in_the_scene_beside_the_file_is_named_with_that_file(
    bench: Path, text: str, line: int, key: str, words: str
) -> None:
    bench.with_name("bench.scene.yaml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        plan_in_world(bench, "sim")
    error = caught.value.problems[0] if isinstance(caught.value, InvalidCell) else caught.value
    assert (Path(error.file).name, error.line) == ("bench.scene.yaml", line)
    assert error.key == key
    assert words in error.reason


def test_devices_that_nothing_simulates_are_left_out_with_the_reason_where_no_task_needs_them(bench: Path) -> None:
    bench.write_text(bench.read_text() + "devices:\n  gripper: {driver: robotiq, port: /dev/ttyUSB0}\n")
    plan = plan_in_world(bench, "sim")
    assert "gripper: left out, as nothing simulates a gripper" in plan.notes
    assert "gripper" in plan.skipped
    assert "gripper" not in plan.built
    assert not any("gripper" in note for note in plan_in_world(bench, "bench").notes)


@pytest.mark.parametrize("world", [None, "sim", "emulated", "bench"])
def test_two_devices_at_one_address_are_refused_by_their_keys(world: WorldName | None) -> None:
    settings = {
        "arms.leader": {**yaml.safe_load(BENCH.read_text())["arms"]["arm"], "host": "192.168.1.10"},
        "arms.follower.host": "192.168.1.10",
        "sensors.leader_sensor.device": "/dev/null",
        "sensors.follower_sensor.device": "/dev/../dev/null",
    }
    with pytest.raises(InvalidCell) as caught:
        plan_in_world(CONFIGS / "dual_push_bench.yaml", world, settings=settings)
    found = {(each.key, each.reason) for each in caught.value.problems}
    assert ("arms.follower.host", "'leader' is there already") in found
    assert ("sensors.follower_sensor.device", "'leader_sensor' is there already") in found


@pytest.mark.parametrize(("first", "clash"), [(1, True), (7, False)])
def test_arms_share_a_bus_if_no_two_of_their_motors_answer_to_one_number(first: int, clash: bool) -> None:
    plan = plan_cell(CONFIGS / "steps_damiao_bench.yaml", to_run=False)
    arm = plan.arms["arm"]
    motors = [
        motor.model_copy(update={"esc_id": first + k, "mst_id": first + k + 32})
        for k, motor in enumerate(arm.config.motors)
    ]
    other = replace(arm, name="other", config=arm.config.model_copy(update={"motors": tuple(motors)}))
    assert bool(list(clashes({"arm": arm, "other": other}))) == clash
    assert len(set(addresses(replace(plan, arms={"arm": arm, "other": other})).values())) == 2


@pytest.mark.parametrize("world", ["sim", "emulated"])
@pytest.mark.parametrize(
    ("start", "words"), [([330, 0, 486.9, 180, 0, 0], "deep in something"), ([306.9, 0, 600, 180, 0, 0], "leader_box")]
)
def test_a_stand_in_or_emulator_that_would_start_in_contact_or_outside_its_workspace_is_refused(
    world: WorldName, start: list[float], words: str
) -> None:
    with pytest.raises(InvalidCell) as refused:
        plan_in_world(CONFIGS / "dual_push_emulated.yaml", world, settings={"arms.leader.start_pose_mm_deg": start})
    assert [problem.key for problem in refused.value.problems] == ["arms.leader.start_pose_mm_deg"]
    assert words in refused.value.problems[0].reason
