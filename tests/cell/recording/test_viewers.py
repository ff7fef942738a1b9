"""Recordings of shipped cells as other people's programs read them: the ``mcap`` package, and Rerun's command line."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import time
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

import touchcell as tc
from touchcell.cell.cli.main import main
from touchcell.cell.config.find import find_cell
from touchcell.cell.config.schema import plan_cell
from touchcell.cell.recording.mcap import Message, read
from touchcell.cell.recording.recorded_images import ImageDecoder, recorded_images
from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.runtime.compose import compose
from touchcell.cell.runtime.loop import RunLoop

CELLS = {
    "surface_follow_sim": (["task.distance_mm=20", "recording.frames=jpeg"], {"arms": 1, "sensors": 1, "objects": []}),
    "object_track_panda_sim": (["max_duration_s=4"], {"arms": 1, "sensors": 1, "objects": ["surfaces/plate"]}),
    "dual_push_sim": (["max_duration_s=4"], {"arms": 2, "sensors": 2, "objects": ["objects/prism"]}),
}


@pytest.fixture(scope="module", params=CELLS)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, Path]:
    """Return the name of a shipped cell and the run folder of a short run."""
    folder = tmp_path_factory.mktemp(request.param) / "run"
    settings = [word for each in CELLS[request.param][0] for word in ("--set", each)]
    main(["run", f"configs/{request.param}.yaml", "--out", str(folder), "--quiet", *settings])
    return request.param, folder


def decoded(folder: Path) -> list[tuple[Any, Any, Any, Any]]:
    """Return schema, channel, message and decoded message of everything in a recording."""
    protobuf = pytest.importorskip("mcap_protobuf.decoder", reason="pip install mcap-protobuf-support")
    with (folder / "run.mcap").open("rb") as stream:
        return list(make_reader(stream, decoder_factories=[protobuf.DecoderFactory()]).iter_decoded_messages())


def test_every_arm_sensor_and_object_has_a_place_in_a_tree_of_frames(recorded: tuple[str, Path]) -> None:
    name, folder = recorded
    expected = CELLS[name][1]
    parents = {
        message.child_frame_id: message.parent_frame_id
        for schema, _, _, message in decoded(folder)
        if schema.name == "foxglove.FrameTransform"
    }
    assert sum(bool(re.fullmatch(r"arms/\w+/tcp", frame)) for frame in parents) == expected["arms"]
    assert sum(bool(re.fullmatch(r"sensors/\w+", frame)) for frame in parents) == expected["sensors"]
    assert sum(bool(re.fullmatch(r"sensors/\w+/contact", frame)) for frame in parents) == expected["sensors"]
    assert set(expected["objects"]) <= parents.keys()
    if "panda" in name:
        assert {f"arms/arm/link{k}" for k in range(1, 8)} <= parents.keys()
    for frame in parents:
        steps = 0
        while frame != "world":
            frame, steps = parents[frame], steps + 1
            assert steps < 10


def test_everything_that_is_drawn_is_in_a_frame_that_has_a_place(recorded: tuple[str, Path]) -> None:
    name, folder = recorded
    messages = decoded(folder)
    frames = {m.child_frame_id for schema, _, _, m in messages if schema.name == "foxglove.FrameTransform"} | {"world"}
    (scene,) = (message for schema, _, _, message in messages if schema.name == "foxglove.SceneUpdate")
    drawn = " ".join(entity.id for entity in scene.entities)
    assert {entity.frame_id for entity in scene.entities} <= frames
    wanted = {
        "surface_follow_sim": "ramp path",
        "object_track_panda_sim": "plate",
        "dual_push_sim": "prism target path",
    }
    assert all(word in drawn for word in wanted[name].split())


def test_beliefs_carry_the_covariance_whose_deviations_are_recorded(recorded: tuple[str, Path]) -> None:
    _, folder = recorded
    run = tc.read_run(folder)
    beliefs = defaultdict(list)
    for schema, channel, _, message in decoded(folder):
        if schema.name == "foxglove.PoseInFrame":
            beliefs[channel.topic].append(message)
    assert beliefs
    for topic, messages in beliefs.items():
        contact = run[topic.replace("/belief", "/contact")]
        sigma = contact["sigma_z_mm"][np.isfinite(contact["sigma_z_mm"])]
        # Viewers have a belief ten times a second, the numbers one for each cycle.
        assert len(sigma) / 20 < len(messages) < len(sigma) / 5
        for message in messages:
            covariance = np.array(message.covariance).reshape(6, 6)
            drawn = 1e3 * np.sqrt(covariance[2, 2])
            # Of single precision.
            assert np.abs(sigma / drawn - 1.0).min() < 1e-6


def test_the_log_has_every_event_and_every_violation(recorded: tuple[str, Path]) -> None:
    _, folder = recorded
    counts = Counter(schema.name for schema, *_ in decoded(folder))
    messages = list(read(folder / "run.mcap"))
    events = sum(message.topic == "/events" for message in messages)
    violations = sum(len(message.data["violations"]) for message in messages if message.topic == "/safety")
    assert counts["foxglove.Log"] == events + violations > 0


def test_the_file_says_what_ran_and_when(recorded: tuple[str, Path]) -> None:
    name, folder = recorded
    with (folder / "run.mcap").open("rb") as stream:
        reader = make_reader(stream)
        attachments = {attachment.name: attachment.data for attachment in reader.iter_attachments()}
        (metadata,) = (record.metadata for record in reader.iter_metadata() if record.name == "touchcell")
    assert attachments["cell.yaml"] == (folder / "cell.yaml").read_bytes()
    assert metadata["cell"] == name
    assert any(key.startswith("model_of_") for key in metadata)
    age_s = time.time() - 1e-9 * int(metadata["wall_clock_start_ns"])
    assert 0 < age_s < 3600
    first = next(read(folder / "run.mcap"))
    with (folder / "run.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    offset_ns = int(metadata["wall_clock_start_ns"]) - int(metadata["cell_clock_start_ns"])
    assert summary.statistics.message_start_time - offset_ns <= first.t_ns


def test_rerun_draws_transforms_images_and_the_log(recorded: tuple[str, Path], tmp_path: Path) -> None:
    if importlib.util.find_spec("rerun_cli") is None:
        pytest.skip("rerun-sdk is not installed (pip install 'touchcell[rerun]')")
    _, folder = recorded
    rerun = [sys.executable, "-m", "rerun_cli"]
    target = tmp_path / "run.rrd"
    subprocess.run([*rerun, "mcap", "convert", folder / "run.mcap", "-o", target], check=True, capture_output=True)
    printed = subprocess.run([*rerun, "rrd", "print", target], check=True, capture_output=True, text=True).stdout
    rows: Counter[str] = Counter()
    places: dict[str, set[str]] = defaultdict(set)
    for count, entity, columns in re.findall(r"with (\d+) rows .*? - (/\S+) - data columns: \[(.*?)\]", printed):
        for component in {column.split(":")[0] for column in columns.split()}:
            rows[component] += int(count)
            places[component].add(entity)
    messages = list(read(folder / "run.mcap"))
    violations = sum(len(message.data["violations"]) for message in messages if message.topic == "/safety")
    assert rows["TextLog"] == violations + sum(message.topic == "/events" for message in messages)
    assert rows["EncodedImage"] == sum(message.topic.endswith("/image") for message in messages)
    moved = {f"/frames/{message.topic[1:]}" for message in messages if re.fullmatch(r"/arms/\w+/tcp", message.topic)}
    assert moved <= places["Transform3D"]


def test_an_image_comes_back_from_every_kind_of_compression(tmp_path: Path) -> None:
    kinds = ["png", "jpeg"] + (["video"] if importlib.util.find_spec("av") else [])
    images = {}
    for kind in kinds:
        settings = {"recording.frames": kind, "max_duration_s": 0.8}
        cell = compose(plan_cell(find_cell(Path("configs/surface_follow_sim.yaml")), settings=settings))
        with Recorder(tmp_path / kind) as recorder, cell:
            RunLoop(cell, recorder).run()
        images[kind] = list(recorded_images(read(tmp_path / kind)))
    exact = images["png"]
    assert len(exact) > 15
    for kind in kinds[1:]:
        assert [each.t_ns for each in images[kind]] == [each.t_ns for each in exact]
        off = [np.abs(a.image.astype(int) - b.image).mean() for a, b in zip(images[kind], exact, strict=True)]
        assert max(off) < 4.0


def test_a_damaged_packet_of_a_video_is_no_picture() -> None:
    pytest.importorskip("av")
    message = Message("/sensors/s/video", 0, {"format": "h264", "data": b"no video"})
    assert ImageDecoder().decode(Message("/task", 0, {})) is None
    assert list(recorded_images([message])) == []
