from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.v4l2 import jpeg
from touchcell.drivers.v4l2.emulator import picture

SIZE = (320, 240)
pytestmark = pytest.mark.skipif(jpeg._compiled is None, reason="only the C extension reads the scan")


def image(color: bool = False) -> np.ndarray:
    grey = picture.synthetic(7, *SIZE)
    return np.dstack([grey, np.roll(grey, 9, 0), np.roll(grey, 9, 1)]) if color else grey


def encoded(color: bool = False, *options: int) -> bytes:
    return bytes(cv2.imencode(".jpg", image(color), list(options))[1].tobytes())


def scan_start(data: bytes) -> int:
    at = data.index(b"\xff\xda")
    return at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")


def without_tables(data: bytes) -> bytes:
    """Return ``data`` as Motion JPEG cameras send it: without Huffman tables."""
    at, kept = 2, data[:2]
    while data[at + 1] != 0xDA:
        length = 2 + int.from_bytes(data[at + 2 : at + 4], "big")
        kept += b"" if data[at + 1] == 0xC4 else data[at : at + length]
        at += length
    return kept + data[at:]


PICTURES = {
    "grey": encoded(),
    "colour": encoded(True),
    "colour not subsampled": encoded(True, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444),
    "colour 4:2:2": encoded(True, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422),
    "own tables": encoded(True, cv2.IMWRITE_JPEG_OPTIMIZE, 1),
    "restart markers": encoded(True, cv2.IMWRITE_JPEG_RST_INTERVAL, 5),
    "progressive": encoded(True, cv2.IMWRITE_JPEG_PROGRESSIVE, 1),
    "best quality": encoded(True, cv2.IMWRITE_JPEG_QUALITY, 100),
    "no tables": without_tables(encoded(True)),
}
SEQUENTIAL = [name for name in PICTURES if name != "progressive"]


@pytest.mark.parametrize("name", PICTURES)
@pytest.mark.parametrize("padding", [b"", bytes(7), b"\xff" * 5, b"\x13\xff\xd8\x07", b"\xff\xd9"], ids=repr)
def test_a_picture_that_decodes_is_good_whatever_follows_it(name: str, padding: bytes) -> None:
    data = PICTURES[name] + padding
    assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) is not None
    assert jpeg.damage(data, *SIZE) == ""


@pytest.mark.parametrize("name", SEQUENTIAL)
@pytest.mark.parametrize("tail", [b"", b"\xff\xd9", bytes(64) + b"\xff\xd9"], ids=repr)
@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_a_scan_that_ends_too_early_is_damaged_even_with_an_end_marker(name: str, share: float, tail: bytes) -> None:
    data = PICTURES[name]
    start = scan_start(data)
    cut = data[: start + int(share * (len(data) - start))].rstrip(b"\xff")
    assert jpeg.damage(cut + tail, *SIZE)


@pytest.mark.parametrize("name", SEQUENTIAL)
def test_a_lost_packet_within_the_scan_is_damage(name: str) -> None:
    data = PICTURES[name]
    middle = (scan_start(data) + len(data)) // 2
    assert jpeg.damage(data[:middle] + data[middle + 512 :], *SIZE)


@pytest.mark.parametrize("name", SEQUENTIAL)
def test_the_tail_of_an_earlier_frame_within_the_scan_is_damage(name: str) -> None:
    data = PICTURES[name]
    middle = (scan_start(data) + len(data)) // 2
    earlier = bytes(cv2.imencode(".jpg", np.roll(image(), 40, 1))[1].tobytes())
    assert jpeg.damage(data[:middle] + earlier[-700:], *SIZE)


def test_another_size_is_named() -> None:
    assert "320" in jpeg.damage(PICTURES["grey"], 640, 480)


@given(st.binary(max_size=200))
def test_noise_is_never_a_picture(noise: bytes) -> None:
    assert jpeg.damage(noise, *SIZE)


@given(st.data())
def test_altered_bytes_never_break_the_check(draw: st.DataObject) -> None:
    data = bytearray(PICTURES[draw.draw(st.sampled_from(sorted(PICTURES)))])
    for _ in range(draw.draw(st.integers(1, 8))):
        data[draw.draw(st.integers(2, len(data) - 1))] = draw.draw(st.integers(0, 255))
    assert isinstance(jpeg.damage(bytes(data), *SIZE), str)
