from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from touchcell.cell.cli.catalog import describe
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.config.truth import TruthSection, sample
from touchcell.cell.config.yaml_file import InvalidCell
from touchcell.cell.runtime.compose import compose
from touchcell.geometry import se3
from touchcell.paths import CONFIGS

TRUTH: dict[str, Any] = {
    "arms": {
        "arm": {
            "base_offset_mm_deg": [{"normal": [0, 1]}, 0, 0, 0, 0, 0],
            "latency_ms": {"uniform": [0, 30]},
            "lag_ms": 20,
            "velocity_step_mm_s": 1,
            "velocity_step_deg_s": 0.5,
        }
    },
    "sensors": {
        "sensor": {
            "mount_offset_mm_deg": [0, 0, 0, 0, 2, 0],
            "tip": {"choice": ["franka_tactip_1"]},
            "rate_hz": 25,
            "noise": {"uniform": [1, 3]},
            "zoom": 1.01,
            "shift_px": [{"uniform": [-2, 2]}, 1],
        }
    },
    "tip": {"slip_exponent": {"uniform": [1.7, 1.9]}},
    "objects": {"prism": {"mass_g": 600, "friction": {"uniform": [0.2, 0.4]}, "center_of_mass_mm": [0, 8]}},
    "table": {"tilt_deg": [1, 0]},
}


def cell(tmp_path: Path, truth: Any, **changes: Any) -> Path:
    data = yaml.safe_load((CONFIGS / "single_push_sim.yaml").read_text()) | {"truth": truth} | changes
    path = tmp_path / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def test_truth_reaches_scene_and_devices_and_leaves_what_the_controllers_are_told(tmp_path: Path) -> None:
    plan = plan_cell(cell(tmp_path, TRUTH))
    told = plan_cell(CONFIGS / "single_push_sim.yaml")
    np.testing.assert_array_equal(plan.cell.sensors["sensor"].T_tcp_sensor, told.cell.sensors["sensor"].T_tcp_sensor)
    np.testing.assert_array_equal(plan.cell.arms["arm"].T_world_base, np.eye(4))
    assert plan.task_config == told.task_config
    arm, sensor = plan.arms["arm"].config.model_dump(), plan.sensors["sensor"].config.model_dump()
    assert arm["base_pose_mm_deg"][0] == pytest.approx(plan.truth["arms.arm.base_offset_mm_deg"][0])
    assert 0.0 <= arm["latency_ms"] <= 30.0
    assert (arm["lag_ms"], arm["velocity_step_mm_s"], sensor["rate_hz"], sensor["zoom"]) == (20, 1, 25, 1.01)
    mounted = se3.from_euler_mm_deg(np.array(sensor["tcp_to_sensor_mm_deg"]))
    offset = se3.inverse(plan.cell.sensors["sensor"].T_tcp_sensor) @ mounted
    np.testing.assert_allclose(se3.to_euler_mm_deg(offset), [0, 0, 0, 0, 2, 0], atol=1e-9)
    assert plan.cell.scene is not None
    prism = plan.cell.scene["objects"]["prism"]
    assert (prism["mass_g"], prism["center_of_mass_mm"]) == (600, [0, 8])
    assert 0.2 <= prism["friction"] <= 0.4
    assert plan.cell.scene["tip"]["stiffness_n_mm"] == 0.6
    assert plan.cell.scene["table"] == {"friction": "mdf", "tilt_deg": [1, 0]}
    compose(plan)


def test_another_seed_samples_another_truth_and_the_same_seed_the_same(tmp_path: Path) -> None:
    first, again, other = (plan_cell(cell(tmp_path, TRUTH, seed=seed)).truth for seed in (1, 1, 2))
    assert first == again
    assert first != other


@given(st.integers(0, 2**31))
def test_a_further_key_leaves_what_the_others_sample(seed: int) -> None:
    some = TruthSection.model_validate(TRUTH)
    more = TruthSection.model_validate({**TRUTH, "tip": {**TRUTH["tip"], "friction": {"normal": [0.9, 0.1]}}})
    before, after = sample(some, seed).values, dict(sample(more, seed).values)
    assert 0.6 <= after.pop("tip.friction") <= 1.2
    assert after == before


@pytest.mark.parametrize(
    ("truth", "key"),
    [
        ({"objects": {"prsim": {"mass_g": 1}}}, "truth.objects.prsim"),
        ({"arms": {"leader": {}}}, "truth.arms.leader"),
        ({"tip": {"radius": 3}}, "truth.tip.radius"),
        ({"tip": {"radius_mm": {"uniform": [3, 1]}}}, "truth.tip.radius_mm"),
        ({"objects": {"prism": {"mass_g": -5}}}, "scene.objects.prism.mass_g"),
        ({"sensors": {"sensor": {"rate_hz": 0}}}, "sensors.sensor.rate_hz"),
    ],
)
def test_a_truth_that_cannot_be_is_refused_with_its_key(tmp_path: Path, truth: Any, key: str) -> None:
    with pytest.raises(InvalidCell) as caught:
        plan_cell(cell(tmp_path, truth))
    assert any(key in problem.key for problem in caught.value.problems)


def test_a_cell_without_a_scene_has_no_truth(tmp_path: Path) -> None:
    data = yaml.safe_load((CONFIGS / "single_push_bench.yaml").read_text()) | {"truth": {"tip": {"friction": 1}}}
    path = tmp_path / "bench.yaml"
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(InvalidCell) as caught:
        plan_cell(path)
    assert any(problem.key == "truth" for problem in caught.value.problems)


def test_every_key_of_the_truth_is_described_with_its_unit() -> None:
    keys = {key.name: key for key in describe("section", "truth").keys}
    assert keys["sensors.*.latency_ms"].unit == "ms"
    assert all(key.meaning for key in keys.values())
