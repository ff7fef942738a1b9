"""``touchcell run|report ... --animate``: an animated GIF of a run, made from its recording."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg

from touchcell.cell.analysis.frame_poses import frame_poses
from touchcell.cell.analysis.run_folder import Poses, RunFolder, object_poses, scene_time, sensor_poses, true_contacts
from touchcell.cell.analysis.scene_picture import ScenePicture
from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.recorded_images import recorded_images
from touchcell.cell.scene.description import BODY_COLOUR, SceneDescription, describe_scene
from touchcell.cell.scene.frames import sensor_frame
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.tip import Tip

if TYPE_CHECKING:
    from PIL.Image import Image

_INCHES, _DPI = (9.0, 5.4), 80
_FRAMES_PER_S = 12
_COLOURS = 96
_MARGIN_M, _ABOVE_M = 0.05, 0.12

Images = Callable[[float], ImageArray]


@dataclass(frozen=True)
class _Shown:
    """What is drawn: the run, its scene, the poses of all frames and of the sensors over time, and images by sensor."""

    run: RunFolder
    scene: SceneDescription
    tips: Mapping[str, Poses]
    images: Mapping[str, Images]

    def extent_m(self) -> tuple[Array, Array]:
        """Return the smallest and the largest coordinates (3,) of everything that moves, with a margin."""
        moved = [*self.tips.values(), *object_poses(self.run).values()]
        places = [each.T_world[:, :3, 3] for each in moved]
        if self.scene.target is not None:
            places.append(self.scene.target[None])
        every = np.concatenate(places)
        return every.min(axis=0) - _MARGIN_M, every.max(axis=0) + _MARGIN_M + np.array([0.0, 0.0, _ABOVE_M])


def animate(folder: Path, *, max_frames: int = 90) -> Path:
    """Write ``animation.gif`` into a run's folder: the cell in three dimensions, and what each sensor feels.

    Tactile images are the recorded ones; where none were recorded, they are rendered from the true contact.

    Args:
        folder: of a run in a simulated scene.
        max_frames: largest number of frames; the run is never shown slower than real time.

    Raises:
        RecordingError, ConfigError: the folder holds no run, or one of real devices.
    """
    run = RunFolder(folder)
    if run.plan.cell.scene is None:
        raise ConfigError("only a simulated run can be animated: the true poses are unknown", key="scene")
    names = {name: role for role, name in run.plan.sensor_roles.items()}
    roles = [names[name] for name in run.plan.cell.sensors if name in names]
    shown = _Shown(
        run,
        describe_scene(run.plan),
        {role: sensor_poses(run, role) for role in roles},
        {role: images for role in roles if (images := _tactile(run, role)) is not None},
    )
    poses = next(iter(shown.tips.values()))
    start_s, end_s = float(poses.t_s[0]), float(poses.t_s[-1])
    count = max(2, min(max_frames, round((end_s - start_s) * _FRAMES_PER_S)))
    path = folder / "animation.gif"
    # The first frame is encoded with the following ones, and the last one is shown longer.
    pictures = list(_pictures(shown, np.linspace(start_s, end_s, count)))
    pause_ms = [1000 // _FRAMES_PER_S] * (count - 1) + [1500]
    pictures[0].save(path, save_all=True, append_images=pictures[1:], duration=pause_ms, loop=0, optimize=True)
    return path


def _pictures(shown: _Shown, times_s: Array) -> Iterator[Image]:
    from PIL import Image

    figure = plt.figure(figsize=_INCHES, dpi=_DPI, layout="constrained")
    stage = _Stage(shown, figure, times_s)
    canvas = FigureCanvasAgg(figure)
    palette = None
    try:
        for moment in range(len(times_s)):
            stage.show(moment)
            canvas.draw()
            # The layout is computed once.
            figure.set_layout_engine("none")
            picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
            # One palette for all, so that static parts are identical in every frame and take no space.
            palette = palette or picture.quantize(_COLOURS)
            yield picture.quantize(palette=palette, dither=Image.Dither.NONE)
    finally:
        plt.close(figure)


class _Stage:
    """The figure: the cell in three dimensions, and beside it what each sensor feels."""

    def __init__(self, shown: _Shown, figure: Any, times_s: Array) -> None:
        self._shown = shown
        self._times_s = times_s
        self._trails: list[Artist] = []
        columns = figure.add_gridspec(1, 2 if shown.images else 1, width_ratios=(3.6, 1) if shown.images else (1,))
        self._axis = figure.add_subplot(columns[0], projection="3d")
        self._axis.view_init(elev=28, azim=-62)
        poses = frame_poses(shown.run.recording, shown.scene, times_s - 1e-9 * shown.run.recording.start_ns)
        self._picture = ScenePicture(self._axis, shown.scene, poses, *shown.extent_m())
        self._images = {}
        for i, role in enumerate(shown.images):
            axis = figure.add_subplot(columns[1].subgridspec(len(shown.images), 1)[i])
            axis.set_title(f"{role.replace('_', ' ')} feels", fontsize=9, color=self._colour(role))
            axis.set_axis_off()
            self._images[role] = axis.imshow(shown.images[role](0.0), cmap="gray", vmin=0, vmax=255)

    def show(self, moment: int) -> None:
        """Draw one moment."""
        t_s = float(self._times_s[moment])
        self._picture.show(moment)
        while self._trails:
            self._trails.pop().remove()
        for role, poses in self._shown.tips.items():
            past = poses.T_world[poses.t_s <= t_s][:, :3, 3]
            self._trails += self._axis.plot(*past.T, color=self._colour(role), lw=1.2, zorder=3, clip_on=False)
        for role, picture in self._images.items():
            picture.set_data(self._shown.images[role](t_s))
        self._axis.set_title(self._caption(t_s), fontsize=10, loc="left")

    def _colour(self, role: str) -> tuple[float, float, float]:
        """Return the colour of the tip of a sensor: that of its arm."""
        frame = sensor_frame(role)
        red, green, blue, _ = next(
            part.colour for part in self._shown.scene.parts if part.frame == frame and part.colour != BODY_COLOUR
        )
        return red, green, blue

    def _caption(self, t_s: float) -> str:
        recording = self._shown.run.recording
        task = recording.series("/task")
        now_s = t_s - 1e-9 * recording.start_ns
        state = ""
        if task is not None:
            state = str(task.rows[max(0, int(np.searchsorted(task.t_s, now_s, side="right")) - 1)].get("state", ""))
        faster = (self._times_s[-1] - self._times_s[0]) / len(self._times_s) * _FRAMES_PER_S
        plan = self._shown.run.plan
        return f"{plan.task.name.replace('_', ' ')}: {state:<10} t {now_s:5.1f} s   {faster:.1f}x"


def _tactile(run: RunFolder, role: str) -> Images | None:
    """Return a function from scene time to a sensor's image; None where neither images nor contacts are known."""
    recorded = [image for image in recorded_images(read(run.path / "run.mcap")) if image.role == role]
    if recorded:
        times_s = np.array([image.t_ns * 1e-9 for image in recorded])

        def seen(t_s: float) -> ImageArray:
            return recorded[max(0, int(np.searchsorted(times_s, t_s, side="right")) - 1)].image

        return seen
    if run.recording.series(f"/sensors/{role}/truth") is None:
        return None
    series, contacts = true_contacts(run, role)
    true_s, tip = scene_time(run, series), Tip()
    renderer = FrameRenderer(tip.parameters.disc_radius_px)

    def drawn(t_s: float) -> ImageArray:
        contact = contacts[max(0, int(np.searchsorted(true_s, t_s, side="right")) - 1)]
        T_f_s = se3.from_euler_mm_deg(np.nan_to_num(contact))
        return renderer.processed(tip.pixels(T_f_s))

    return drawn
