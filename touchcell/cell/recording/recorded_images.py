"""Camera images out of a recording, whatever they were compressed by."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import cv2
import numpy as np

from touchcell.cell.recording.mcap import Message
from touchcell.geometry.types import ImageArray
from touchcell.perception.errors import ImageError

IMAGE_TOPICS = ("image", "video")
"""Last part of the topics of a sensor's images."""


class RecordedImage(NamedTuple):
    """One image: of the sensor of a role, at the time of its exposure; uint8 (height, width) or (height, width, 3)."""

    role: str
    t_ns: int
    image: ImageArray


def is_image(topic: str) -> bool:
    """Return whether the messages of a topic are images of a sensor."""
    parts = topic.split("/")
    return len(parts) == 4 and parts[1] == "sensors" and parts[3] in IMAGE_TOPICS


class ImageDecoder:
    """Decodes the images of a recording, in their order."""

    def __init__(self) -> None:
        self._videos: dict[str, Any] = {}

    def decode(self, message: Message) -> RecordedImage | None:
        """Return the image of a message; None for another message, and for a video packet that shows nothing yet.

        Raises:
            ImageError: it is damaged.
        """
        if not is_image(message.topic):
            return None
        role = message.topic.split("/")[2]
        data, format_ = message.data.get("data", b""), str(message.data.get("format"))
        # Recordings of 0.2.0 and before are JSON, which has no bytes.
        content = base64.b64decode(data) if isinstance(data, str) else bytes(data)
        image = self._packet(message.topic, content) if format_ == "h264" else _still(content, format_)
        return None if image is None else RecordedImage(role, message.t_ns, image)

    def _packet(self, topic: str, content: bytes) -> ImageArray | None:
        import av

        codec = self._videos.get(topic)
        if codec is None:
            codec = self._videos[topic] = av.CodecContext.create("h264", "r")
            codec.thread_type = "NONE"
            codec.flags |= av.codec.context.Flags.low_delay
        try:
            frames = codec.decode(av.Packet(content))
        except av.FFmpegError as error:
            raise ImageError("content", "h264", f"no picture: {error}") from None
        # Colour is kept in the other planes; tactile images are grey.
        return (
            np.ascontiguousarray(frames[-1].reformat(format="yuvj420p").to_ndarray()[: frames[-1].height])
            if frames
            else None
        )


def recorded_images(messages: Iterable[Message]) -> Iterator[RecordedImage]:
    """Yield each image of a recording; those that cannot be decoded are left out."""
    decoder = ImageDecoder()
    for message in messages:
        try:
            image = decoder.decode(message)
        except ImageError:
            continue
        if image is not None:
            yield image


def _still(content: bytes, format_: str) -> ImageArray:
    image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_ANYCOLOR) if content else None
    if image is None:
        raise ImageError("content", format_, "no image")
    return np.asarray(image, dtype=np.uint8)
