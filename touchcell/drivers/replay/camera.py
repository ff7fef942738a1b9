"""Camera that plays a folder of images on the injected clock, for recorded and public data."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import Field

from touchcell.drivers.core.clock import Clock
from touchcell.drivers.core.device import Device, Lifecycle
from touchcell.drivers.core.errors import (
    ConnectError,
    CorruptMessage,
    DeviceGone,
    EndOfStream,
    StaleData,
    TransportTimeout,
)
from touchcell.drivers.core.protocols import FrameSource, HealthSource
from touchcell.drivers.core.samples import Frame, Stamped
from touchcell.drivers.core.spec import Capabilities, DriverConfig, DriverContext, DriverSpec
from touchcell.drivers.replay.dataset import (
    IMAGE_SUFFIXES,
    image_folder_of,
    label_file_of,
    natural_order,
    read_image,
    read_split,
    split_folder,
)
from touchcell.errors import DataError
from touchcell.geometry.types import ImageArray
from touchcell.input_file import InputFile

CAPABILITIES = Capabilities(
    kind="camera",
    provides=frozenset({FrameSource, HealthSource}),
    state_rate_hz=30.0,
    virtual_time=True,
)

_READABLE = (Lifecycle.PASSIVE, Lifecycle.READY, Lifecycle.ACTIVE)


class ReplayCameraConfig(DriverConfig):
    """Images to play, and their rate.

    Attributes:
        data: a folder of images, or with ``split`` the root of a data set in the public layout.
        split: train, val or test.
        rate_hz: images per second.
    """

    data: Annotated[Path, InputFile("a data set", folder=True)]
    split: str | None = None
    rate_hz: float = Field(default=30.0, gt=0.0, le=1000.0)


class ReplayCamera(Device):
    """Plays PNG and JPEG images, and last frames of videos, in natural name order, image_2 before image_10.

    Of a labelled split it plays, in grey, the images that have a label and no others, so that a replay arm reports the
    pose of the image that is played.

    Image k is exposed k periods after ``connect``. As with a live camera, images that are not read in time are lost;
    they are not even opened. All images must have the same size.

    Args:
        name: the device's name in the cell.
        config: checked configuration.
        clock: injected clock.
    """

    def __init__(self, name: str, config: ReplayCameraConfig, clock: Clock) -> None:
        super().__init__(name, clock)
        self._config = config
        split = config.split
        self._folder = image_folder_of(split_folder(config.data, split)) if split else config.data
        self._period_ns = round(1e9 / config.rate_hz)
        self._files: list[Path] = []
        self._start_ns = 0
        self._size: tuple[int, ...] | None = None
        self._newest: Stamped[Frame] | None = None
        self._read = 0

    def latest(self, max_age_s: float | None = None) -> Stamped[Frame]:
        """Return the newest image. Raises StaleData, CorruptMessage, DeviceGone, EndOfStream after the last."""
        self._require("deliver frames", *_READABLE)
        now_ns = self._clock.now_ns()
        seq = (now_ns - self._start_ns) // self._period_ns
        self._refuse_end(seq)
        age_s = (now_ns - self._exposed_ns(seq)) * 1e-9
        if max_age_s is not None and age_s > max_age_s:
            raise StaleData(self.name, age_s, max_age_s, seq)
        return self._load(seq)

    def next(self, after_seq: int, timeout_s: float) -> Stamped[Frame]:
        """Return the newest image if its ``seq > after_seq``, else wait for the first that is.

        Raises:
            TransportTimeout: it is not due within ``timeout_s``.
            EndOfStream: there are no more.
            CorruptMessage: the file is not a complete image, or differs in size from the previous ones.
            DeviceGone: the file no longer exists.
        """
        self._require("deliver frames", *_READABLE)
        now_ns = self._clock.now_ns()
        seq = max((now_ns - self._start_ns) // self._period_ns, after_seq + 1)
        self._refuse_end(seq)
        deadline_ns = now_ns + round(timeout_s * 1e9)
        if self._exposed_ns(seq) > deadline_ns:
            self._clock.sleep_until_ns(deadline_ns)
            raise TransportTimeout(self.name, f"frame after {after_seq}", timeout_s)
        self._clock.sleep_until_ns(self._exposed_ns(seq))
        return self._load(seq)

    def health(self) -> dict[str, float | int | str | bool]:
        """Return the number of images and the number that were read."""
        return {"images": len(self._files), "images_read": self._read}

    def _exposed_ns(self, seq: int) -> int:
        return self._start_ns + seq * self._period_ns

    def _refuse_end(self, seq: int) -> None:
        if seq >= len(self._files):
            raise EndOfStream(self.name, f"all {len(self._files)} images of {self._folder} have been played")

    def _load(self, seq: int) -> Stamped[Frame]:
        if self._newest is None or self._newest.seq != seq:
            image = self._decode(self._files[seq])
            if self._size is None:
                self._size = image.shape
            if image.shape != self._size:
                raise CorruptMessage(
                    self.name,
                    f"{self._files[seq].name} has shape {image.shape}, the previous images {self._size}",
                    hint="a camera does not change its image size; sort the images into folders",
                )
            self._newest = Stamped(Frame(image), self._exposed_ns(seq), seq)
            self._read += 1
        return self._newest

    def _decode(self, file: Path) -> ImageArray:
        try:
            return read_image(file, colour=self._config.split is None)
        except DataError as error:
            if not file.is_file():
                raise DeviceGone(self.name, str(error)) from None
            raise CorruptMessage(self.name, str(error)) from None

    def _open(self) -> None:
        if not self._folder.is_dir():
            raise ConnectError(
                self.name,
                f"{self._folder} is not a folder",
                hint="give the folder that contains the images, or the data set and its split",
            )
        self._files = self._listed()
        if not self._files:
            raise ConnectError(self.name, f"{self._folder} contains no PNG or JPEG images")
        self._start_ns = self._clock.now_ns()

    def _listed(self) -> list[Path]:
        split = self._config.split
        if split is not None and label_file_of(split_folder(self._config.data, split)) is not None:
            try:
                return list(read_split(self._config.data, split).in_order().images)
            except DataError as error:
                raise ConnectError(self.name, "the data set cannot be read", [error]) from None
        files = (file for file in self._folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
        return sorted(files, key=natural_order)

    def _close(self) -> None:
        self._files = []
        self._size = None
        self._newest = None


def _build(name: str, config: ReplayCameraConfig, context: DriverContext) -> ReplayCamera:
    return ReplayCamera(name, config, context.clock)


SPEC = DriverSpec(
    name="replay_camera",
    summary="plays a folder of images as a camera",
    config=ReplayCameraConfig,
    capabilities=CAPABILITIES,
    build=_build,
)
