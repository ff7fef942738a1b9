"""Data collection: contacts as drawn, frames that match their labels, data sets continued after interrupted runs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.helpers.kinematic_plant import CONTEXT, KinematicPlant
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.dataset_writer import Collection
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop
from touchcell.cell.runtime.run_result import Outcome, Progress, RunResult
from touchcell.cell.runtime.stop_request import StopRequest
from touchcell.control.reach import Reach, is_there
from touchcell.drivers.replay.dataset import read_rest, read_split
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.gaussian import PoseGaussian
from touchcell.paths import CONFIGS
from touchcell.perception.runtime.estimate import ContactEstimate
from touchcell.tasks.data_collection import SPEC, DataCollectionConfig

FAST = {"settle_ms": 0, "speed_mm_s": 80, "press_speed_mm_s": 40, "turn_deg_s": 80}


class KnownPlane(KinematicPlant):
    """A kinematic plant with a sensor that knows its surface, in contact or not."""

    def _estimate(self) -> ContactEstimate:
        found = super()._estimate()
        self.T_w_f[:3, 3] = 0.0
        T_s_f = se3.inverse(self.sensor_in_surface())
        return replace(found, belief=PoseGaussian(T_s_f, np.eye(6) * 1e-8))


def cell_file(folder: Path, **task: Any) -> Path:
    data = yaml.safe_load((CONFIGS / "collect_sim.yaml").read_text())
    data["task"] |= {"samples": 4, **FAST, **task}
    data["arms"]["arm"]["limits"]["tcp_accel_m_s2"] = 2.0
    # Above the 80 deg/s that are commanded, below three times the speed of the gate.
    data["interlocks"]["tcp_speed"]["limit_rad_s"] = 1.45
    data["collect"]["data"] = str(folder / "data")
    path = folder / "cell.yaml"
    path.write_text(yaml.safe_dump(data))
    return path


def run(path: Path, stop_after: int | None = None) -> RunResult:
    cell, stop = compose(plan_cell(path)), StopRequest()

    def on_cycle(progress: Progress) -> None:
        if stop_after is not None and progress.telemetry.get("sample", 0.0) >= stop_after and stop.count == 0:
            stop.ask()

    with cell:
        return RunLoop(cell, None, stop=stop, on_cycle=on_cycle).run()


def tables(folder: Path) -> list[str]:
    return [(folder / "data" / split / "targets_images.csv").read_text() for split in ("train", "val")]


def test_a_stopped_collection_continues_to_the_same_data(tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    whole.mkdir()
    broken.mkdir()
    assert run(cell_file(whole)).outcome is Outcome.DONE
    assert run(cell_file(broken), stop_after=1).outcome is Outcome.STOPPED
    assert read_split(broken / "data", "train").contact_mm_deg.shape == (1, 6)
    with (broken / "data" / "train" / "targets_images.csv").open("a") as table:
        table.write("image_2.png,1.0,2.")
    assert run(cell_file(broken)).outcome is Outcome.DONE
    labels = [read_split(each / "data", split) for split in ("train", "val") for each in (whole, broken)]
    assert [len(each.images) for each in labels] == [3, 3, 1, 1]
    np.testing.assert_allclose(labels[0].contact_mm_deg, labels[1].contact_mm_deg, atol=0.05)
    assert run(cell_file(whole)).outcome is Outcome.DONE
    assert len(read_split(whole / "data", "train").images) == 3


def test_frames_match_their_labels(tmp_path):
    run(cell_file(tmp_path))
    split = read_split(tmp_path / "data", "train")
    z = split.contact_mm_deg[:, 2]
    assert ((z > 0.45) & (z < 6.05)).all()
    images = list(split.read())
    assert images[0].shape == (440, 445)
    deepest, shallowest = images[int(z.argmax())], images[int(z.argmin())]
    assert np.mean(deepest != shallowest) > 0.02
    # Out of contact the tip resembles the lightest contact more than the deepest.
    rest = read_rest(tmp_path / "data")
    assert rest is not None
    assert np.mean(rest != shallowest) < np.mean(rest != deepest)


def test_a_folder_with_other_samples_is_refused(tmp_path):
    Collection(tmp_path / "data", {"train": 3, "val": 1}, {"seed": 1})
    with pytest.raises(ConfigError, match="other settings"):
        run(cell_file(tmp_path))
    (tmp_path / "more").mkdir()
    (tmp_path / "more" / "thesis.txt").write_text("precious")
    with pytest.raises(ConfigError, match="not empty"):
        Collection(tmp_path / "more", {"train": 1}, {})


def test_a_labelling_task_requires_storage_for_its_frames_and_vice_versa(tmp_path):
    path = cell_file(tmp_path)
    data = yaml.safe_load(path.read_text())
    del data["collect"]
    path.write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match="labels frames"):
        plan_cell(path)
    data = yaml.safe_load((CONFIGS / "surface_follow_sim.yaml").read_text())
    path.write_text(yaml.safe_dump(data | {"collect": {"data": "x"}}))
    with pytest.raises(ConfigError, match="labels no frames"):
        plan_cell(path)


def test_each_sample_is_reached_as_drawn():
    config = DataCollectionConfig(samples=3, seed=5, **FAST)
    plant, task, labels = KnownPlane(), SPEC.build(config, CONTEXT), []
    while not task.finished:
        labels += [se3.to_euler_mm_deg(T) for T in plant.cycle(task).labels.values()]
    assert task.succeeded
    assert len(labels) == 3
    later = SPEC.build(config, replace(CONTEXT, kept=2))
    plant = KnownPlane()
    last = [se3.to_euler_mm_deg(T) for _ in range(3000) for T in plant.cycle(later).labels.values()]
    np.testing.assert_allclose(last, labels[2:], atol=0.1)
    states = [record.target for record in task.transitions]
    assert states[1:7] == ["tilt", "press", "shear", "grab", "lift", "tilt"]


@pytest.mark.parametrize("state", ["lift", "tilt", "press", "shear", "grab"])
@pytest.mark.parametrize("loss", ["frames", "states"])
def test_without_fresh_data_nothing_moves_and_the_task_trips(state, loss):
    plant, task = KnownPlane(), SPEC.build(DataCollectionConfig(samples=2, **FAST | {"settle_ms": 50}), CONTEXT)
    plant.run(task, until=state)
    setattr(plant, loss, False)
    moving = sum(bool(action.twists) for action in plant.run(task))
    assert moving <= 26
    assert task.state == "tripped"


@pytest.mark.parametrize("state", ["lift", "tilt", "press", "shear", "grab"])
def test_a_stop_withdraws_the_sensor(state):
    plant, task = KnownPlane(), SPEC.build(DataCollectionConfig(samples=2, **FAST), CONTEXT)
    plant.run(task, until=state)
    plant.operator_stop = True
    plant.run(task)
    assert task.state == "stopped"
    assert plant.sensor_in_surface()[2, 3] == pytest.approx(-0.003, abs=1e-4) or state in ("lift", "tilt")


def test_a_sequence_stays_in_contact_and_labels_every_frame_with_where_the_sensor_was():
    config = DataCollectionConfig(samples=500, motions="sequence", sequence_frames=300, seed=5, **FAST)
    plant, task, labels, late = KnownPlane(), SPEC.build(config, CONTEXT), [], []
    while not task.finished:
        before = plant.sensor_in_surface()
        for T_f_s in plant.cycle(task).labels.values():
            labels.append(se3.to_euler_mm_deg(T_f_s))
            late.append(min(np.linalg.norm((T - T_f_s)[:3, 3]) for T in (before, plant.sensor_in_surface())))
    contact = np.array(labels)
    assert task.succeeded
    assert len(contact) == 500
    # Both sequences begin in the air and then stay in contact.
    first, second = contact[:300], contact[300:]
    for sequence in (first, second):
        touching = sequence[:, 2] > 0.0
        assert not touching[0]
        assert touching[touching.argmax() :].all()
    assert np.hypot(first[:, 0], first[:, 1]).max() > 1.0
    assert max(late) < 1e-3
    states = [record.target for record in task.transitions]
    assert "grab" not in states
    assert states.count("lift") == 3


def test_sequences_are_collected_in_simulation_with_labels_of_the_time_of_the_frame(tmp_path):
    assert run(cell_file(tmp_path, samples=40, motions="sequence", sequence_frames=40)).outcome is Outcome.DONE
    split = read_split(tmp_path / "data", "train")
    assert len(split.images) == 30
    assert split.contact_mm_deg[0, 2] < 0.0
    assert (split.contact_mm_deg[10:, 2] > 0.4).all()


def test_a_collection_begun_before_a_setting_existed_is_continued(tmp_path):
    Collection(tmp_path / "data", {"train": 1}, {"seed": 1})
    about = {"seed": 1, "motions": "single"}
    assert Collection(tmp_path / "data", {"train": 1}, about, {"motions": "single"}).kept == 0
    with pytest.raises(ConfigError, match="other settings"):
        Collection(tmp_path / "data", {"train": 1}, {"seed": 1, "motions": "sequence"}, {"motions": "single"})


@settings(max_examples=50)
@given(st.lists(st.floats(-0.3, 0.3), min_size=12, max_size=12))
def test_reaching_ends_at_the_goal_within_its_limits(numbers):
    reach = Reach(8.0, 0.05, 0.5)
    T, goal = se3.exp(np.array(numbers[:6])), se3.exp(np.array(numbers[6:]))
    for _ in range(3000):
        V = reach.twist(T, goal)
        assert np.linalg.norm(V[:3]) <= 0.05 * (1 + 1e-9)
        assert np.linalg.norm(V[3:]) <= 0.5 * (1 + 1e-9)
        T = se3.compose(T, se3.exp(0.01 * V))
        if is_there(T, goal, 1e-5, 1e-4):
            return
    raise AssertionError("did not arrive")
