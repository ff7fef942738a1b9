"""Markers in the images of a run: tracked from its first image, in the report and live in a browser."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from touchcell.cell.analysis.contact_images import contact_pictures
from touchcell.cell.cli.main import main
from touchcell.cell.recording.mcap import RECORDING, follow, read
from touchcell.cell.recording.recorder import Recorder
from touchcell.geometry import se3
from touchcell.paths import CONFIGS
from touchcell.perception.errors import ImageError
from touchcell.perception.markers.figures import density_change, draw_contact
from touchcell.perception.markers.tracking import MarkerTracker
from touchcell.simulation.contact import ContactLaw, contact_at
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.tip import Tip

SHIPPED = CONFIGS / "surface_follow_sim.yaml"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run with the learned estimator and its images."""
    data = yaml.safe_load(SHIPPED.read_text())
    data["task"]["distance_mm"] = 5
    data["recording"] = {"frames": "png"}
    path = tmp_path_factory.mktemp("pictures")
    (path / "cell.yaml").write_text(yaml.safe_dump(data))
    assert main(["run", str(path / "cell.yaml"), "--out", str(path / "run"), "--quiet"]) == 0
    return path / "run"


def test_discs_are_tracked_into_a_contact() -> None:
    tip, renderer, corner = Tip(), FrameRenderer(), np.array([105.0, 20.0])
    rest = tip.project(tip.rest_positions)
    tracker = MarkerTracker(renderer.processed(rest))
    first = tracker.update(renderer.processed(rest))
    order = np.linalg.norm(first.positions[:, None] + corner - rest, axis=2).argmin(axis=1)
    for share in np.linspace(0.05, 1.0, 20):
        pose = se3.from_euler_mm_deg(share * np.array([1.5, -1.0, 4.0, 8.0, -5.0, 3.0]))
        true = tip.pixels(contact_at(pose, ContactLaw()).T_f_s[None])[0]
        markers = tracker.update(renderer.processed(true))
        assert markers.followed
    off = np.linalg.norm(markers.positions + corner - true[order], axis=1)[markers.seen]
    assert np.percentile(off, 99) < 0.5
    assert np.linalg.norm(markers.positions - markers.reference, axis=1).max() > 8.0


def test_a_jump_is_not_tracked() -> None:
    tip, renderer = Tip(), FrameRenderer()
    rest = tip.project(tip.rest_positions)
    tracker = MarkerTracker(renderer.processed(rest))
    assert tracker.update(renderer.processed(rest)).followed
    assert not tracker.update(np.zeros((440, 445), np.uint8)).followed
    with pytest.raises(ImageError):
        MarkerTracker(np.zeros((440, 445), np.uint8))


def test_following_and_reading_a_recording_give_the_same(folder: Path) -> None:
    def never() -> bool:
        raise AssertionError("a finished recording has an end")

    assert list(follow(folder / RECORDING, never)) == list(read(folder / RECORDING))


def test_following_waits_for_further_messages(tmp_path: Path) -> None:
    path = tmp_path / RECORDING
    written = 0
    with Recorder(path) as recorder:

        def write_more() -> bool:
            nonlocal written
            if written == 3000:
                return False
            for _ in range(300):
                recorder.write("/x", written, {"i": written, "text": "filler " * (written % 7)})
                written += 1
            return True

        found = [message.data["i"] for message in follow(path, write_more)]
    assert found == list(range(len(found)))
    # The last chunk is still open.
    assert 2000 < len(found) <= 3000


def test_pictures_of_a_run_show_the_contact(folder: Path) -> None:
    pictures = list(contact_pictures(read(folder / RECORDING)))
    assert len(pictures) > 20
    assert all(picture.markers.followed for picture in pictures)
    moved = [np.linalg.norm(p.markers.positions - p.markers.reference, axis=1).mean() for p in pictures]
    assert moved[0] == 0.0
    assert max(moved) > 2.0
    assert pictures[0].image.shape == (440, 445)
    assert cv2.imread(str(folder / "markers_sensor.png")).std() > 10.0
    assert "markers_sensor.png" in (folder / "summary.txt").read_text()


def test_red_where_markers_crowd() -> None:
    reference = np.stack(np.meshgrid(np.arange(20.0, 181.0, 8.0), np.arange(20.0, 181.0, 8.0)), axis=-1).reshape(-1, 2)
    crowded = np.where(reference[:, :1] < 100, reference * [0.5, 1.0] + [50, 0], reference)
    change = density_change(crowded, reference, (200, 200), 8.0)
    assert change[25, 20] > 0.3
    assert change[25, 8] < -0.5
    drawn = draw_contact(np.zeros((200, 200), np.uint8), reference, crowded, 8.0, arrows=True)
    assert drawn.shape == (200, 400, 3)
    blue, _, red = drawn[100, 200 + 80].astype(int)
    assert red > blue + 30
    blue, _, red = drawn[100, 200 + 33].astype(int)
    assert blue > red + 30
    assert drawn[:, :200].any()
    assert not draw_contact(np.zeros((200, 200), np.uint8), reference, crowded, 8.0, arrows=False)[:, :200].any()
