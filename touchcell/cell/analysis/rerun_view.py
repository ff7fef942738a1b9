"""A run in Rerun: its recording, what Rerun does not read of it, and a blueprint. Imported only when it is wanted."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
import rerun_cli

from touchcell.cell.analysis.run_folder import RunFolder
from touchcell.cell.recording.mcap import RECORDING, read, wall_clock_offset_ns
from touchcell.cell.recording.recorded_images import is_image
from touchcell.cell.recording.salvage import whole
from touchcell.cell.recording.viewer_record import LOG_TOPIC
from touchcell.cell.scene.description import SceneDescription, describe_scene
from touchcell.cell.scene.frames import WORLD
from touchcell.geometry.solids import Polyline, triangulated

_VIEWER_ANSWERS_S: Final = 60.0
"""A viewer that could not start takes nothing, and its client waits for it."""


def show_in_rerun(folder: Path, target: Path | None = None) -> None:
    """Open a run in Rerun's viewer, or write it as a file for it.

    Args:
        folder: run folder.
        target: ``.rrd`` file to write instead of opening a viewer.

    Raises:
        ConfigError: the cell file of the run cannot be read.
        RuntimeError: the viewer does not start, or has gone.
    """
    run = RunFolder(folder)
    scene = describe_scene(run.plan)
    recording = rr.RecordingStream("touchcell", recording_id=folder.resolve().name)
    images = sorted({message.topic for message in read(folder / RECORDING) if is_image(message.topic)})
    plots = [f"/arms/{role}" for role in run.plan.arm_roles]
    blueprint = _blueprint(images, plots)
    if target is None:
        # Not searched for in PATH: an environment need not be activated.
        viewer = Path(rerun_cli.__file__).with_name("rerun")
        rr.spawn(
            executable_path=str(viewer) if viewer.exists() else None, default_blueprint=blueprint, recording=recording
        )
    else:
        recording.save(target, default_blueprint=blueprint)
    # First what is small: a viewer that reads as it comes draws the scene while it waits for images.
    _log_scene(recording, scene)
    _log_numbers(recording, run)
    with whole(folder / RECORDING) as readable:
        recording.log_file_from_path(readable)
        recording.flush(timeout_sec=_VIEWER_ANSWERS_S)


def _blueprint(images: list[str], plots: list[str]) -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(
                    name="cell",
                    origin="/",
                    contents=["/drawn/**", "/frames/**"],
                    spatial_information=rrb.SpatialInformation(target_frame=WORLD),
                ),
                *([rrb.Horizontal(*(rrb.Spatial2DView(name=each, origin=each) for each in images))] if images else []),
                row_shares=[2, 1] if images else None,
            ),
            rrb.Vertical(
                rrb.TimeSeriesView(name="depth (mm)", origin="/numbers/depth_mm"),
                rrb.TimeSeriesView(name="tool speed (mm/s)", origin="/numbers/speed_mm_s"),
                rrb.TextLogView(name="log", origin=LOG_TOPIC),
            ),
            column_shares=[3, 2],
        ),
        collapse_panels=True,
    )


def _log_scene(recording: rr.RecordingStream, scene: SceneDescription) -> None:
    """Log what is drawn, each part in the frame that the recording moves: Rerun reads no ``foxglove.SceneUpdate``."""
    for number, part in enumerate(scene.parts):
        entity = f"/drawn/{part.name.replace(' ', '_')}/{number}"
        recording.log(entity, rr.CoordinateFrame(part.frame), static=True)
        colour = [round(255 * value) for value in part.colour]
        mesh = triangulated(part.solid)
        points = mesh.vertices_m @ part.T_frame_solid[:3, :3].T + part.T_frame_solid[:3, 3]
        if isinstance(part.solid, Polyline):
            recording.log(entity, rr.LineStrips3D([points], colors=[colour]), static=True)
            continue
        corners = points[mesh.triangles]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        recording.log(
            entity,
            rr.Mesh3D(
                vertex_positions=corners.reshape(-1, 3),
                vertex_normals=np.repeat(normals, 3, axis=0),
                albedo_factor=colour,
            ),
            static=True,
        )


def _log_numbers(recording: rr.RecordingStream, run: RunFolder) -> None:
    """Log depths and speeds as scalars on the recording's own timeline."""
    offset_ns = wall_clock_offset_ns(run.path / RECORDING)
    for kind, leaf, column, name in (("sensors", "contact", "z_mm", "depth_mm"), ("arms", "tcp", "speed_mm_s", "")):
        for role in run.recording.roles(kind, leaf):
            series = run.recording.series(f"/{kind}/{role}/{leaf}")
            assert series is not None
            stamps = np.round(1e9 * series.t_s).astype(np.int64) + run.recording.start_ns + offset_ns
            recording.send_columns(
                f"/numbers/{name or column}/{role}",
                indexes=[rr.TimeColumn("message_log_time", timestamp=stamps.astype("datetime64[ns]"))],
                columns=rr.Scalars.columns(scalars=series.column(column)),
            )
