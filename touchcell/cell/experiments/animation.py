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

from touchcell.cell.analysis.run_folder import Poses, RunFolder, object_poses, scene_time, sensor_poses, true_contacts
from touchcell.cell.experiments.scenes import scene
from touchcell.cell.recording.mcap import read
from touchcell.cell.recording.recorded_images import recorded_images
from touchcell.errors import ConfigError
from touchcell.geometry import se3
from touchcell.geometry.types import Array, ImageArray
from touchcell.simulation.outlines import ABOVE, SIDE, View, height_mm, solid_outlines_mm, tip_outlines_mm
from touchcell.simulation.render import FrameRenderer
from touchcell.simulation.scene import SceneConfig
from touchcell.simulation.tip import Tip

if TYPE_CHECKING:
    from PIL.Image import Image

_INCHES, _DPI = (9.0, 5.4), 80
_FRAMES_PER_S = 12
_COLOURS = 128
_TIP_COLOURS = ("#4c72b0", "#dd8452", "#55a868")
_BODY_COLOUR, _OBJECT_COLOUR, _TABLE_COLOUR, _TARGET_COLOUR = "#e8e8e8", "#e5c494", "#bfb8ae", "#d62728"
# Above the tips, so that a pressed tip appears flattened.
_TOUCHED = 3
_MARGIN_MM = 45.0

Images = Callable[[float], ImageArray]


@dataclass(frozen=True)
class _Shown:
    """Poses over time of everything that is drawn, by name."""

    run: RunFolder
    scene: SceneConfig
    tips: Mapping[str, Poses]
    objects: Mapping[str, Poses]
    images: Mapping[str, Images]

    def extent_mm(self, view: View) -> Array:
        """Return (2, 2) smallest and largest coordinates of everything that moves."""
        points = [1e3 * poses.T_world[:, list(view), 3] for poses in (*self.tips.values(), *self.objects.values())]
        every = np.concatenate([np.reshape(each, (-1, 2)) for each in points])
        tall = max((1e3 * config.shape.build().height_m for config in self.scene.objects.values()), default=0.0)
        high = np.array([0.0, tall if view == SIDE else 0.0])
        return np.stack([every.min(axis=0) - _MARGIN_MM, every.max(axis=0) + _MARGIN_MM + high])


def animate(folder: Path, *, max_frames: int = 90) -> Path:
    """Write ``animation.gif`` into a run's folder: top and side view, and the image of each sensor.

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
        scene(run),
        {role: sensor_poses(run, role) for role in roles},
        object_poses(run),
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
    stage = _Stage(shown, figure, faster=(times_s[-1] - times_s[0]) / len(times_s) * _FRAMES_PER_S)
    canvas = FigureCanvasAgg(figure)
    palette = None
    try:
        for t_s in times_s:
            stage.show(float(t_s))
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
    """The figure: static parts are drawn once, moving ones are removed and redrawn."""

    def __init__(self, shown: _Shown, figure: Any, *, faster: float) -> None:
        self._shown = shown
        self._faster = faster
        self._moving: list[Artist] = []
        extent = {view: shown.extent_mm(view) for view in (ABOVE, SIDE)}
        columns = figure.add_gridspec(1, 2 if shown.images else 1, width_ratios=(3.4, 1) if shown.images else (1,))
        heights = [float(np.diff(extent[view][:, 1])[0]) for view in (ABOVE, SIDE)]
        left_half = columns[0].subgridspec(2, 1, height_ratios=heights)
        self._views = {ABOVE: figure.add_subplot(left_half[0]), SIDE: figure.add_subplot(left_half[1])}
        for view, axis in self._views.items():
            (left, low), (right, high) = extent[view]
            axis.set_xlim(left, right)
            axis.set_ylim(low, high)
            axis.set_aspect("equal")
            axis.set_ylabel(("from above, y" if view == ABOVE else "from the side, z") + " (mm)", fontsize=8)
            axis.tick_params(labelsize=7)
        self._views[SIDE].set_xlabel("x (mm)", fontsize=8)
        self._pictures = {}
        for i, role in enumerate(shown.images):
            axis = figure.add_subplot(columns[1].subgridspec(len(shown.images), 1)[i])
            axis.set_title(f"{role.replace('_', ' ')} sees", fontsize=8, color=_TIP_COLOURS[i % 3])
            axis.set_axis_off()
            self._pictures[role] = axis.imshow(shown.images[role](0.0), cmap="gray", vmin=0, vmax=255)
        self._draw_still()

    def show(self, t_s: float) -> None:
        """Draw the state at ``t_s``."""
        while self._moving:
            self._moving.pop().remove()
        shown, radius_m = self._shown, 1e-3 * self._shown.scene.tip.radius_mm
        for view, axis in self._views.items():
            for name, poses in shown.objects.items():
                self._draw_object(axis, name, poses.at(np.array([t_s]))[0], view, fill=_OBJECT_COLOUR)
            for i, poses in enumerate(shown.tips.values()):
                T_world_s = poses.at(np.array([t_s]))[0]
                body, tip = tip_outlines_mm(T_world_s, radius_m, view)
                hidden = view == ABOVE and T_world_s[2, 2] < -0.5
                self._moving += axis.fill(*tip.T, fc=_TIP_COLOURS[i % 3], ec="black", lw=0.6, zorder=2)
                self._moving += axis.fill(*body.T, fc=_BODY_COLOUR, ec="black", lw=0.6, zorder=2.5 if hidden else 1.5)
                past = 1e3 * poses.T_world[poses.t_s <= t_s][:, list(view), 3]
                self._moving += axis.plot(*past.T, color=_TIP_COLOURS[i % 3], lw=0.9)
        self._draw_moving_surfaces(t_s)
        for role, picture in self._pictures.items():
            picture.set_data(shown.images[role](t_s))
        self._views[ABOVE].set_title(self._caption(t_s), fontsize=9, loc="left")

    def _caption(self, t_s: float) -> str:
        recording = self._shown.run.recording
        task = recording.series("/task")
        now_s = t_s - 1e-9 * recording.start_ns
        state = ""
        if task is not None:
            state = str(task.rows[max(0, int(np.searchsorted(task.t_s, now_s, side="right")) - 1)].get("state", ""))
        plan = self._shown.run.plan
        return f"{plan.task.name.replace('_', ' ')}: {state:<10} t {now_s:5.1f} s   {self._faster:.1f}x"

    def _draw_still(self) -> None:
        shown = self._shown
        for view, axis in self._views.items():
            for name, poses in shown.objects.items():
                self._draw_object(axis, name, poses.T_world[0], view, fill=None)
        if shown.scene.objects:
            low, high = self._views[SIDE].get_ylim()
            self._views[SIDE].axhspan(low - 1e3, shown.scene.table.height_mm, color=_TABLE_COLOUR, lw=0, zorder=0)
            self._views[SIDE].set_ylim(low, high)
        target = shown.run.plan.task_config.model_dump().get("target_mm")
        if target is not None:
            self._views[ABOVE].plot(target[0], target[1], "o", ms=9, mfc="none", mec=_TARGET_COLOUR, mew=1.2, zorder=6)
            self._views[ABOVE].plot(target[0], target[1], ".", ms=4, color=_TARGET_COLOUR, zorder=6)
            self._views[SIDE].axvline(target[0], color=_TARGET_COLOUR, lw=0.8, ls=":")
        for config in shown.scene.surfaces.values():
            if config.motion is None:
                self._draw_profile(config.build(), 0.0)

    def _draw_moving_surfaces(self, t_s: float) -> None:
        for config in self._shown.scene.surfaces.values():
            if config.motion is not None:
                self._moving += self._draw_profile(config.build(), t_s)

    def _draw_profile(self, surface: Any, t_s: float) -> list[Artist]:
        """Draw a surface from the side, below the first tip."""
        axis = self._views[SIDE]
        T_world_s = next(iter(self._shown.tips.values())).at(np.array([t_s]))[0]
        low = axis.get_ylim()[0]
        left, right = axis.get_xlim()
        x_mm = np.linspace(left, right, 60)
        heights = height_mm(surface, 1e-3 * x_mm, float(T_world_s[1, 3]), t_s)
        return [axis.fill_between(x_mm, heights, low, color=_TABLE_COLOUR, lw=0, zorder=_TOUCHED)]

    def _draw_object(self, axis: Any, name: str, T_world_object: Array, view: View, fill: str | None) -> None:
        for outline in solid_outlines_mm(self._shown.scene.objects[name].shape.build(), T_world_object, view):
            if fill is None:
                axis.plot(*outline.T, color="black", lw=0.7, ls=":")
            else:
                self._moving += axis.fill(*outline.T, fc=fill, ec="black", lw=0.8, zorder=_TOUCHED)


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
