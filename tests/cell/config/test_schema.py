"""A bad cell file is refused with file, line, key and remedy, before anything is built."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.errors import ConfigError
from touchcell.paths import CONFIGS

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


def written(tmp_path: Path, *changes: tuple[str, str]) -> Path:
    """The shipped cell with some of its text replaced."""
    text = SHIPPED.read_text()
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    return path


def refused(path: Path) -> ConfigError:
    with pytest.raises(ConfigError) as caught:
        plan_cell(path)
    assert caught.value.file == str(path)
    return caught.value


def line_of(path: Path, words: str) -> int:
    return next(i for i, line in enumerate(path.read_text().splitlines(), start=1) if words in line)


@pytest.mark.parametrize("path", sorted(SHIPPED.parent.glob("*.yaml")), ids=lambda path: path.name)
def test_every_cell_that_ships_is_valid(path: Path) -> None:
    replays = path.name == "replay_real.yaml"
    plan = plan_cell(path, {"data": path.parent} if replays else {}, model="builtin:sim_gdn" if replays else None)
    assert plan.task.name == plan.cell.task.name


def test_plan_holds_validated_devices_and_task() -> None:
    plan = plan_cell(SHIPPED)
    assert set(plan.arms) == {"arm"}
    assert plan.arms["arm"].spec.name == "sim_arm"
    assert plan.sensor_roles == {"sensor": "sensor"}
    assert plan.task_config.model_dump()["depth_mm"] == 3
    assert plan.skipped == ()


def test_unknown_driver(tmp_path: Path) -> None:
    path = written(tmp_path, ("driver: sim_arm", "driver: sim_amr"))
    error = refused(path)
    assert (error.key, error.value) == ("arms.arm.driver", "sim_amr")
    assert error.line == line_of(path, "sim_amr")
    assert "sim_arm" in error.hint


def test_unknown_key_of_a_driver_suggests_the_right_one(tmp_path: Path) -> None:
    path = written(tmp_path, ("latency_ms: 10", "latncy_ms: 10"))
    error = refused(path)
    assert error.key == "sensors.sensor.latncy_ms"
    assert error.line == line_of(path, "latncy_ms")
    assert "latency_ms" in error.hint


def test_unknown_key_of_the_cell(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("rate_hz: 100\n", "rate_hz: 100\nmax_duraton_s: 5\n")))
    assert error.key == "max_duraton_s"
    assert "max_duration_s" in error.hint


def test_unknown_key_inside_a_tagged_section(tmp_path: Path) -> None:
    path = written(tmp_path, ("bend_radius_mm: 150", "bend_radus_mm: 150"))
    problems = {problem.key: problem for problem in _problems(path)}
    assert "bend_radius_mm" in problems["scene.surfaces.ramp.bend_radus_mm"].hint
    assert problems["scene.surfaces.ramp.bend_radius_mm"].reason == "is missing"


def test_all_mistakes_are_named_at_once(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        ("driver: sim_arm", "driver: sim_amr"),
        ("name: surface_following", "name: surface_folowing"),
        ("mounted_on: arm", "mounted_on: amr"),
    )
    assert {problem.key for problem in _problems(path)} >= {"arms.arm.driver", "task.name", "sensors.sensor.mounted_on"}


def test_inverted_limits(tmp_path: Path) -> None:
    path = written(tmp_path, ("min_mm: [-150, -50, 10]", "min_mm: [-150, -50, 200]"))
    error = refused(path)
    assert error.key.startswith("interlocks.workspace")
    assert error.line == line_of(path, "kind: workspace")
    assert "not below" in error.reason


def test_missing_limit(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("{kind: depth, limit_mm: 5}", "{kind: depth}")))
    assert error.key == "interlocks.indentation.limit_mm"
    assert error.reason == "is missing"


def test_a_workspace_whose_arm_cannot_stop_within_its_margin(tmp_path: Path) -> None:
    path = written(tmp_path, ("margin_mm: 15", "margin_mm: 11"))
    error = refused(path)
    assert error.key == "interlocks.workspace.margin_mm"
    assert error.line == line_of(path, "margin_mm: 11")
    # 100 mm/s at 100 Hz, seen 2 ms late, braked with 0.5 m/s^2.
    for number in (
        "100 mm/s",
        "1.0 mm in a cycle",
        "0.2 mm in the arm's latency",
        "10.0 mm to brake",
        "11.2 mm in all",
    ):
        assert number in error.reason
    assert "tcp_speed_m_s" in error.hint
    plan_cell(written(tmp_path, ("margin_mm: 15", "margin_mm: 11.3")))


def test_an_interlock_on_an_arm_that_is_not_there(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("kind: tilt, arm: arm", "kind: tilt, arm: amr")))
    assert error.key == "interlocks.tilt.arm"
    assert "'arm'" in error.hint


def test_a_slower_arm_needs_less_margin(tmp_path: Path) -> None:
    plan_cell(written(tmp_path, ("margin_mm: 15", "margin_mm: 4"), ("tcp_speed_m_s: 0.10", "tcp_speed_m_s: 0.05")))


def test_the_length_of_the_sensor_swings_further(tmp_path: Path) -> None:
    long = ("mounted_on: arm", "mounted_on: arm\n    tcp_to_sensor_mm_deg: [0, 0, 100, 0, 0, 0]")
    high = ("[-80, 0, 25,", "[-80, 0, 125,")
    plan = plan_cell(written(tmp_path, long, high, ("margin_mm: 15", "margin_mm: 30")))
    way = plan.stopping_distances["workspace"]
    assert way.speed_m_s == pytest.approx(0.1 + 0.5 * 0.1)
    assert way.braking_m == pytest.approx(0.01 + 0.5 * 0.05 * 0.5 / 2.5)


def test_a_limit_alone_does_not_bound_a_moving_task(tmp_path: Path) -> None:
    change = ("{kind: depth, limit_mm: 5}", "{kind: depth, limit_mm: 6, severity: limit}")
    error = refused(written(tmp_path, change))
    assert error.key == "interlocks"
    assert "'depth' that stops" in error.reason


def test_a_stop_category_that_the_driver_does_not_offer(tmp_path: Path) -> None:
    plan = plan_cell(written(tmp_path, ("deactivate: hold", "deactivate: hold\n    stop_category: 1")))
    assert plan.cell.arms["arm"].stop_category == 1
    error = refused(written(tmp_path, ("deactivate: hold", "deactivate: hold\n    stop_category: 0")))
    assert error.key == "arms.arm.stop_category"


def test_a_moving_task_must_be_bounded(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("  indentation: {kind: depth, limit_mm: 5}\n", "")))
    assert error.key == "interlocks"
    assert "'depth'" in error.reason


@pytest.mark.parametrize("value", [".nan", ".inf", "-5", "0"])
def test_a_limit_that_is_no_positive_number(tmp_path: Path, value: str) -> None:
    error = refused(written(tmp_path, ("{kind: depth, limit_mm: 5}", f"{{kind: depth, limit_mm: {value}}}")))
    assert error.key == "interlocks.indentation.limit_mm"


def test_deactivation_must_be_chosen(tmp_path: Path) -> None:
    error = refused(written(tmp_path, ("    deactivate: hold\n", "")))
    assert error.key == "arms.arm.deactivate"
    assert error.reason == "is missing"


def test_role_without_device(tmp_path: Path) -> None:
    path = written(tmp_path, ("arms:\n  arm:", "arms:\n  left:"), ("mounted_on: arm", "mounted_on: left"))
    error = refused(path)
    assert error.key == "task.arms.arm"
    assert "left" in error.hint


def test_devices_that_the_task_does_not_need_are_skipped(tmp_path: Path) -> None:
    spare = "  spare: {driver: sim_arm, deactivate: hold, start_pose_mm_deg: [0, 0, 500, 180, 0, 0]}\n\nsensors:"
    plan = plan_cell(written(tmp_path, ("\nsensors:", spare)))
    assert plan.skipped == ("spare",)
    assert set(plan.arms) == {"arm"}


def test_duplicate_key_is_refused(tmp_path: Path) -> None:
    path = written(tmp_path, ("seed: 1\n", "seed: 1\nseed: 2\n"))
    error = refused(path)
    assert error.key == "seed"
    assert error.line == line_of(path, "seed: 2")


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "schema: [1\n", "just words"])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "cell.yaml"
    path.write_text(text)
    refused(path)


def test_missing_file(tmp_path: Path) -> None:
    assert "No such file" in refused(tmp_path / "none.yaml").reason


def test_several_problems_print_one_per_line(tmp_path: Path) -> None:
    path = written(tmp_path, ("seed: 1", "sed: 1"), ("rate_hz: 100", "rate_hz: fast"))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    assert len(str(caught.value).splitlines()) == 2


def test_the_command_line_is_light() -> None:
    program = (
        "import sys, touchcell.cell.cli.main\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'onnxruntime', 'onnx', 'cv2', 'numpy', 'pydantic', 'rich'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "[]"


def test_check_loads_no_heavy_package(tmp_path: Path) -> None:
    program = (
        "import sys\nfrom touchcell.cell.cli.main import main\n"
        f"assert main(['check', {str(SHIPPED)!r}]) == 0\n"
        "heavy = {'torch', 'mujoco', 'matplotlib', 'onnxruntime', 'onnx', 'cv2', 'scipy', 'rich', 'mcap'}\n"
        "print(sorted(heavy & set(sys.modules)))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.strip().endswith("[]")


def _problems(path: Path) -> tuple[ConfigError, ...]:
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    return caught.value.problems


def test_a_key_that_was_renamed_is_answered_with_its_new_name(tmp_path: Path) -> None:
    text = (CONFIGS / "single_push_sim.yaml").read_text()
    assert "\ntask:\n" in text
    path = tmp_path / "cell.yaml"
    path.write_text(text.replace("\ntask:\n", "\ntask:\n  middle_mm: 60\n"))
    error = refused(path)
    assert (error.key, error.reason) == ("task.middle_mm", "was renamed")
    assert error.hint == "write `object_center_offset_mm:`"


def test_a_name_belongs_to_one_device(tmp_path: Path) -> None:
    path = written(tmp_path, ("interlocks:\n", "devices:\n  arm: {driver: replay_camera, data: .}\n\ninterlocks:\n"))
    error = refused(path)
    assert (error.key, error.reason) == ("devices.arm", "another device has this name")


def six_joints() -> str:
    """Return a URDF of an arm with six joints and a gripper's seventh."""
    links = "".join(f'<link name="link{i}"/>' for i in range(8))
    joints = "".join(
        f'<joint name="joint{i}" type="revolute"><parent link="link{i}"/><child link="link{i + 1}"/>'
        f'<origin xyz="0 0 0.1"/><axis xyz="{int(i % 2 == 0)} 0 {int(i % 2)}"/>'
        '<limit lower="-2" upper="2" velocity="2" effort="20"/></joint>'
        for i in range(7)
    )
    return f'<robot name="mine">{links}{joints}</robot>'


@pytest.mark.parametrize(
    ("chain", "says"),
    [
        ("arm.urdf#link6", ""),
        ("arm.urdf", "has 7 joints"),
        ("arm.urdf#link9", "has no link 'link9'"),
        ("other.urdf#link6", "no such file"),
    ],
)
def test_a_chain_is_found_in_a_urdf_beside_the_cell(chain: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "arm.urdf").write_text(six_joints())
    cell = tmp_path / "cell.yaml"
    cell.write_text((CONFIGS / "steps_damiao_bench.yaml").read_text().replace("chain: generic_6r", f"chain: {chain}"))
    if says:
        with pytest.raises((ConfigError, ExceptionGroup)) as caught:
            plan_cell(cell)
        assert says in str(caught.value) + repr(getattr(caught.value, "exceptions", ""))
    else:
        found = plan_cell(cell).arms["arm"].config.described_chain()
        assert found is not None
        assert found.joint_names[-1] == "joint5"
