"""``touchcell calibrate``: zoom, turn and shift of a sensor's camera from a few images out of contact."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path

from touchcell.cell.config.schema import plan_cell
from touchcell.cell.runtime.devices import build_devices
from touchcell.drivers.core.protocols import FrameSource
from touchcell.drivers.replay.dataset import IMAGE_SUFFIXES, natural_order, read_image
from touchcell.errors import ConfigError, DataError
from touchcell.geometry.types import ImageArray
from touchcell.perception.markers.zero_frame import find_change
from touchcell.perception.models.camera_change import CameraChange
from touchcell.perception.models.model_file import load_model

_FRAME_TIMEOUT_S = 5.0


def calibrate(
    model: Path,
    out: Path,
    *,
    frames: Path | None = None,
    cell: Path | None = None,
    sensor: str | None = None,
    count: int = 20,
    taught: Path | None = None,
    rings: int = 10,
) -> CameraChange:
    """Find what differs from the camera that taught ``model``, and write it to ``out``.

    Args:
        model: model file.
        out: ``NAME.yaml``.
        frames: folder with images of the tip out of contact.
        cell: in place of that, the cell file whose sensor takes them now; nothing is energised.
        sensor: which of its sensors; None for the only one.
        count: images that a cell's sensor takes.
        taught: folder with images out of contact of the sensor that taught the model, where the model holds nothing.
        rings: of the marker lattice, where the model does not say.

    Raises:
        ConfigError: the cell file is not valid, or has no such sensor.
        DataError: a folder holds no images.
        DeviceError: the camera does not answer.
        TrainingError, ImageError: as ``find_change``.
    """
    if frames is not None:
        images = images_in(frames)
    elif cell is not None:
        images = take(cell, sensor, count)
    else:
        raise ConfigError("neither images nor a cell to take them", hint="give --frames DIR or --cell FILE")
    before = () if taught is None else images_in(taught)
    change = find_change(load_model(model), images, taught=before, rings=rings)
    change.save(out)
    return change


def images_in(folder: Path) -> list[ImageArray]:
    """All images of a folder, and the last frames of its videos."""
    found = folder.iterdir() if folder.is_dir() else ()
    paths = sorted((path for path in found if path.suffix.lower() in IMAGE_SUFFIXES), key=natural_order)
    if not paths:
        raise DataError(folder, "holds no PNG or JPEG images", hint="record ten or more with the tip out of contact")
    return [read_image(path) for path in paths]


def take(cell: Path, sensor: str | None, count: int) -> list[ImageArray]:
    """``count`` new images of a cell's sensor, whose tip must touch nothing."""
    plan = plan_cell(cell)
    names = sorted(plan.cell.sensors)
    if sensor is None and len(names) == 1:
        sensor = names[0]
    if sensor not in names:
        raise ConfigError(f"no sensor {sensor!r}", key="sensors", hint=f"--sensor takes one of {', '.join(names)}")
    mount = plan.cell.sensors[sensor].mounted_on
    wanted = {name: plan.devices[name] for name in (mount, sensor) if name is not None}
    devices = build_devices(plan, wanted)
    camera = devices[sensor]
    if not isinstance(camera, FrameSource):
        raise ConfigError(f"{sensor!r} delivers no images", key=f"sensors.{sensor}")
    images: list[ImageArray] = []
    with ExitStack() as opened:
        for device in devices.values():
            opened.enter_context(device)
        frame = camera.latest()
        while len(images) < count:
            images.append(frame.value.image)
            frame = camera.next(frame.seq, _FRAME_TIMEOUT_S)
    return images
