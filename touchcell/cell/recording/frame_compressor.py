"""Camera images of a run, compressed by a thread of their own.

The control thread hands images over and writes what comes back, a few microseconds each. The thread itself writes
nothing: the MCAP writer keeps its lock while it waits for the interpreter's.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final, Literal

import numpy as np

from touchcell.cell.recording.recorder import Recorder
from touchcell.cell.recording.well_known import COMPRESSED_IMAGE, COMPRESSED_VIDEO, WellKnown, image_message
from touchcell.cell.scene.frames import sensor_frame
from touchcell.errors import ConfigError
from touchcell.geometry.types import ImageArray

if TYPE_CHECKING:
    from av.video.codeccontext import VideoCodecContext

FramesKind = Literal["jpeg", "png", "video"]

_BACKLOG: Final = 90
# Every second of a camera at 30 Hz begins with a picture that needs no other, so that viewers can begin anywhere.
_KEY_INTERVAL: Final = 30
# Constant rate factor: see docs/decisions/0026-frames-as-video.md for what it costs the estimates.
_QUALITY: Final = 20
_GREY_CHROMA: Final = 128


class FrameCompressor:
    """Compresses images in a thread of its own, from ``start`` to ``close``.

    Args:
        kind: jpeg, png (without loss), or video (H.264).
        complete: whether to wait where the thread falls behind, as simulated time allows; else images are left out and
            counted.

    Attributes:
        left_out: images that were left out.
        error: what ended it.

    Raises:
        ConfigError: PyAV is missing for a video.
    """

    def __init__(self, kind: FramesKind, *, complete: bool) -> None:
        if kind == "video":
            require_video()
        self._complete = complete
        self._kind = kind
        self._encoders: dict[str, Callable[[ImageArray, int], bytes]] = {}
        self._queue: queue.Queue[tuple[str, int, ImageArray] | None] = queue.Queue(_BACKLOG)
        self._done: deque[tuple[str, int, bytes]] = deque()
        self._thread = threading.Thread(target=self._work, name="frame compressor", daemon=True)
        self.left_out = 0
        self.error: Exception | None = None

    def add(self, role: str, t_ns: int, image: ImageArray) -> None:
        """Take one image of the sensor of a role, which must not change later.

        Args:
            role: of the sensor.
            t_ns: time of exposure.
            image: uint8 (height, width) or (height, width, 3) BGR.
        """
        if self.error is not None:
            return
        try:
            self._queue.put((role, t_ns, image), block=self._complete)
        except queue.Full:
            self.left_out += 1

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def close(self) -> None:
        """Compress what is left, and end the thread; again does nothing."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()

    def write_to(self, recorder: Recorder) -> None:
        """Write what is compressed by now. Raises RecordingError as the recorder does."""
        type_: WellKnown = COMPRESSED_VIDEO if self._kind == "video" else COMPRESSED_IMAGE
        while self._done:
            role, t_ns, data = self._done.popleft()
            t_wall_ns = t_ns + recorder.wall_offset_ns
            recorder.write_bytes(
                f"/sensors/{role}/{'video' if self._kind == 'video' else 'image'}",
                t_ns,
                type_,
                image_message(
                    type_, t_wall_ns, sensor_frame(role), "h264" if self._kind == "video" else self._kind, data
                ),
            )

    def _work(self) -> None:
        while (item := self._queue.get()) is not None:
            if self.error is not None:
                # The queue is emptied all the same, so that whoever adds to it does not wait.
                continue
            role, t_ns, image = item
            try:
                self._done.append((role, t_ns, self._compress(role, image, t_ns)))
            except Exception as error:
                self.error = error

    def _compress(self, role: str, image: ImageArray, t_ns: int) -> bytes:
        encode = self._encoders.get(role)
        if encode is None:
            encode = self._encoders[role] = VideoEncoder(image).encode if self._kind == "video" else self._encode_image
        return encode(image, t_ns)

    def _encode_image(self, image: ImageArray, t_ns: int) -> bytes:
        import cv2

        return cv2.imencode(".jpg" if self._kind == "jpeg" else ".png", image)[1].tobytes()


class VideoEncoder:
    """Encodes images of one size as H.264 in Annex B, one packet for each, without reordering.

    Grey levels become luma as they are, over the full range of 0 to 255.

    Args:
        first: an image, for the size; odd rows and columns at the end are repeated.
    """

    def __init__(self, first: ImageArray) -> None:
        import av

        height, width = first.shape[:2]
        self._size = height + height % 2, width + width % 2
        # PyAV types what ``create`` returns by the name of the codec.
        codec: Any = av.CodecContext.create("libx264", "w")
        codec.height, codec.width = self._size
        codec.pix_fmt = "yuvj420p"
        codec.time_base = Fraction(1, 1_000_000)
        codec.framerate = Fraction(_KEY_INTERVAL)
        codec.gop_size = _KEY_INTERVAL
        codec.max_b_frames = 0
        codec.thread_count = 1
        codec.options = {"preset": "veryfast", "tune": "zerolatency", "crf": str(_QUALITY)}
        self._codec: VideoCodecContext = codec

    def encode(self, image: ImageArray, t_ns: int) -> bytes:
        """Return the packet of one image."""
        import av

        height, width = self._size
        grown = ((0, height - image.shape[0]), (0, width - image.shape[1]))
        if image.ndim == 2:
            luma = np.pad(image, grown, mode="edge")
            planes = np.concatenate([luma, np.full((height // 2, width), _GREY_CHROMA, np.uint8)])
            frame = av.VideoFrame.from_ndarray(planes, format="yuvj420p")
        else:
            frame = av.VideoFrame.from_ndarray(np.pad(image, (*grown, (0, 0)), mode="edge"), format="bgr24")
            frame = frame.reformat(format="yuvj420p")
        frame.pts = t_ns // 1000
        return b"".join(bytes(packet) for packet in self._codec.encode(frame))


def require_video() -> None:
    """Raise ConfigError, with what to install, where PyAV is missing."""
    try:
        import av  # noqa: F401
    except ModuleNotFoundError:
        raise ConfigError(
            "needs PyAV, which is not installed",
            key="recording.frames",
            value="video",
            hint="pip install 'touchcell[video]', or frames: jpeg",
        ) from None
