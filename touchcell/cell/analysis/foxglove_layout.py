"""A Foxglove layout for one cell: its scene, images, depths and speeds, the task's state and the log."""

from __future__ import annotations

from touchcell.cell.config.cell_plan import CellPlan
from touchcell.cell.recording.viewer_record import LOG_TOPIC, SCENE_TOPIC
from touchcell.cell.scene.frames import WORLD


def foxglove_layout(plan: CellPlan, images: str = "video") -> str:
    """Return the layout as JSON, to be imported in Foxglove.

    Args:
        plan: the cell.
        images: last part of the topics of the sensors' images.
    """
    import foxglove.layouts as fl

    sensors = list(plan.sensor_roles)
    arms = list(plan.arm_roles)
    frames = fl.BaseRendererSceneSettings(transforms=fl.BaseRendererTransforms(show_label=False))
    scene = fl.ThreeDeePanel(
        config=fl.ThreeDeeConfig(
            fixed_frame=WORLD,
            follow_tf=WORLD,
            follow_mode="follow-none",
            scene=frames,
            layers={"grid": fl.BaseRendererGridLayerSettings(size=2, divisions=20)},
            topics={SCENE_TOPIC: fl.BaseRendererSceneUpdateTopicSettings(visible=True)},
        )
    )
    pictures = [
        fl.SplitItem(
            content=fl.ImagePanel(
                config=fl.ImageConfig(image_mode=fl.ImageModeConfig(image_topic=f"/sensors/{role}/{images}"))
            )
        )
        for role in sensors
    ]
    depth = [fl.PlotSeries(value=f"/sensors/{role}/contact.z_mm", label=f"{role} depth (mm)") for role in sensors]
    speed = [fl.PlotSeries(value=f"/arms/{role}/tcp.speed_mm_s", label=f"{role} speed (mm/s)") for role in arms]
    state = fl.StateTransitionsPanel(
        config=fl.StateTransitionsConfig(paths=[fl.StateTransitionsSeries(value="/task.state", label="task")])
    )
    numbers = fl.SplitContainer(
        direction="column",
        items=[
            *(
                fl.SplitItem(proportion=2, content=fl.PlotPanel(config=fl.PlotConfig(paths=paths, show_legend=True)))
                for paths in (depth, speed)
                if paths
            ),
            fl.SplitItem(content=state),
            fl.SplitItem(content=fl.LogPanel(config=fl.LogConfig(topic_to_render=LOG_TOPIC, min_log_level=1))),
        ],
    )
    seen = fl.SplitContainer(
        direction="column",
        items=[
            fl.SplitItem(proportion=2, content=scene),
            *([fl.SplitItem(content=fl.SplitContainer(direction="row", items=pictures))] if pictures else []),
        ],
    )
    layout = fl.Layout(
        content=fl.SplitContainer(
            direction="row",
            items=[fl.SplitItem(proportion=3, content=seen), fl.SplitItem(proportion=2, content=numbers)],
        )
    )
    return layout.to_json()
