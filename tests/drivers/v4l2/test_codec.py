"""Codec of V4L2: golden values from the kernel's documentation, the kernel's own headers as judge, and mutation."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from touchcell.drivers.v4l2 import codec

HEADER = Path("/usr/include/linux/videodev2.h")

# "ioctl numbers" of the kernel documentation: direction (2 bits: 1 write, 2 read), size (14 bits), type 'V' = 0x56 (8),
# number (8). QUERYCAP reads 104 bytes as number 0: 2 << 30 | 104 << 16 | 0x56 << 8 | 0. The sizes follow from the
# structures in the documentation of each request on a 64-bit machine, e.g. v4l2_buffer: 5 u32, 4 bytes hole, timeval
# 16, timecode 16, sequence, memory, union 8, length, reserved2, request_fd, 4 bytes tail = 88 = 0x58.
GOLDEN_REQUESTS = {
    "QUERYCAP": 0x80685600,
    "ENUM_FMT": 0xC0405602,
    "G_FMT": 0xC0D05604,
    "S_FMT": 0xC0D05605,
    "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609,
    "QBUF": 0xC058560F,
    "DQBUF": 0xC0585611,
    "STREAMON": 0x40045612,
    "STREAMOFF": 0x40045613,
    "G_PARM": 0xC0CC5615,
    "S_PARM": 0xC0CC5616,
    "G_CTRL": 0xC008561B,
    "S_CTRL": 0xC008561C,
    "QUERYCTRL": 0xC0445624,
    "QUERYMENU": 0xC02C5625,
    "G_EXT_CTRLS": 0xC0205647,
    "ENUM_FRAMESIZES": 0xC02C564A,
    "ENUM_FRAMEINTERVALS": 0xC034564B,
    "DQEVENT": 0x80885659,
    "QUERY_EXT_CTRL": 0xC0E85667,
}

REQUESTS = sorted(name for name, value in vars(codec).items() if isinstance(value, int) and value >> 8 & 0xFF == 0x56)

MEMBERS = {
    "v4l2_capability": (codec.Capability, ["card", "bus_info", "version", "capabilities", "device_caps"]),
    "v4l2_pix_format": (codec.PixelFormat, ["pixelformat", "bytesperline", "sizeimage", "priv", "xfer_func"]),
    "v4l2_buffer": (codec.Buffer, ["bytesused", "flags", "sequence", "memory", "length", "request_fd"]),
    "v4l2_queryctrl": (codec.QueryControl, ["name", "minimum", "default_value", "flags"]),
    "v4l2_query_ext_ctrl": (codec.QueryExtendedControl, ["minimum", "step", "flags", "elems", "dims"]),
    "v4l2_ext_controls": (codec.ExtendedControls, ["count", "error_idx", "request_fd", "controls"]),
    "v4l2_ext_control": (codec.ExtendedControl, ["size", "value64"]),
    "v4l2_input": (codec.Input, ["name", "type", "std", "capabilities"]),
    "v4l2_event": (codec.Event, ["pending", "sequence", "id"]),
    "v4l2_requestbuffers": (codec.RequestBuffers, ["count", "memory", "capabilities", "flags"]),
}


@pytest.mark.parametrize(("name", "number"), GOLDEN_REQUESTS.items())
def test_request_numbers_follow_the_documentation(name: str, number: int) -> None:
    assert getattr(codec, name) == number


@pytest.mark.skipif(
    not HEADER.exists() or shutil.which("cc") is None, reason="needs the kernel's headers and a compiler"
)
def test_the_kernel_headers_agree(tmp_path: Path) -> None:
    lines = [f'printf("%lu\\n", (unsigned long)VIDIOC_{name});' for name in REQUESTS]
    expected = [getattr(codec, name) for name in REQUESTS]
    for struct, (layout, members) in MEMBERS.items():
        for member in members:
            lines.append(f'printf("%lu\\n", (unsigned long)offsetof(struct {struct}, {member}));')
            expected.append(getattr(layout, member).offset)
    source = tmp_path / "layout.c"
    source.write_text(
        "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\nint main(void) {" + "".join(lines) + "}"
    )
    subprocess.run(["cc", "-o", str(tmp_path / "layout"), str(source)], check=True)
    printed = subprocess.run([str(tmp_path / "layout")], check=True, capture_output=True, text=True).stdout.split()
    assert [int(word) for word in printed] == expected
    assert len(REQUESTS) == 31


def test_fourcc_is_little_endian_ascii() -> None:
    # v4l2_fourcc(a, b, c, d) = a | b << 8 | c << 16 | d << 24; "YUYV" = 0x59 0x55 0x59 0x56
    assert codec.fourcc("YUYV") == 0x56595559
    assert codec.fourcc_text(0x47504A4D) == "MJPG"
    assert codec.fourcc_text(0x00000101) == "????"


def test_a_filled_buffer_read_from_its_bytes() -> None:
    # index 3, type 1, 1000 bytes used, flags monotonic | start of exposure | error, field none, hole,
    # 12 s, 345678 us, empty timecode, sequence 77, memory mapped, offset 0x600000, length 614400.
    words = (
        (3).to_bytes(4, "little")
        + (1).to_bytes(4, "little")
        + (1000).to_bytes(4, "little")
        + (0x2000 | 0x10000 | 0x40).to_bytes(4, "little")
        + (1).to_bytes(4, "little")
        + bytes(4)
        + (12).to_bytes(8, "little")
        + (345678).to_bytes(8, "little")
        + bytes(16)
        + (77).to_bytes(4, "little")
        + (1).to_bytes(4, "little")
        + (0x600000).to_bytes(8, "little")
        + (614400).to_bytes(4, "little")
        + bytes(12)
    )
    assert codec.arrival(codec.Buffer.from_buffer_copy(words)) == codec.Arrival(
        index=3,
        bytes_used=1000,
        sequence=77,
        stamp_ns=12_345_678_000,
        monotonic=True,
        start_of_exposure=True,
        damaged=True,
    )


@given(st.binary(min_size=88, max_size=88))
def test_any_bytes_of_a_buffer_can_be_read(data: bytes) -> None:
    read = codec.arrival(codec.Buffer.from_buffer_copy(data))
    assert bytes(codec.Buffer.from_buffer_copy(data)) == data
    assert read.monotonic == (int.from_bytes(data[12:16], "little") & 0xE000 == 0x2000)


@given(st.integers(0, 2**32 - 1), st.integers(-(2**31), 2**31 - 1))
def test_sequence_step_survives_the_wrap(before: int, step: int) -> None:
    assert codec.sequence_step(before, (before + step) % 2**32) == step


def _jpeg(width: int = 64, height: int = 48) -> bytes:
    ramp = np.tile(np.arange(width, dtype=np.uint8), (height, 1))
    data: bytes = cv2.imencode(".jpg", ramp)[1].tobytes()
    return data


def test_a_complete_jpeg_is_complete_also_when_padded() -> None:
    assert codec.damage(_jpeg(), "MJPG", 64, 48) == ""
    assert codec.damage(_jpeg() + bytes(100), "MJPG", 64, 48) == ""


@given(st.data())
def test_a_jpeg_cut_anywhere_is_refused(data: st.DataObject) -> None:
    whole = _jpeg()
    # Without its end marker a picture is still complete.
    cut = data.draw(st.integers(0, len(whole) - 3))
    assert codec.damage(whole[:cut], "MJPG", 64, 48) != ""


@given(st.data())
def test_a_mutated_jpeg_never_crashes_and_never_passes_for_another_size(data: st.DataObject) -> None:
    broken = bytearray(_jpeg())
    for _ in range(data.draw(st.integers(1, 8))):
        broken[data.draw(st.integers(0, len(broken) - 1))] = data.draw(st.integers(0, 255))
    if codec.damage(bytes(broken), "MJPG", 64, 48) == "":
        image = cv2.imdecode(np.frombuffer(bytes(broken), np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is None or image.shape == (48, 64)


@given(st.binary(max_size=300))
def test_noise_is_not_a_jpeg(data: bytes) -> None:
    assert codec.damage(data, "MJPG", 64, 48) != ""


@pytest.mark.parametrize(("pixel_format", "whole"), [("YUYV", 6144), ("GREY", 3072)])
def test_raw_frames_must_have_their_length(pixel_format: str, whole: int) -> None:
    assert codec.damage(bytes(whole), pixel_format, 64, 48) == ""
    assert codec.damage(bytes(whole - 1), pixel_format, 64, 48) != ""
    assert codec.damage(bytes(whole + 1), pixel_format, 64, 48) != ""


def test_another_frame_size_is_refused() -> None:
    assert "(64, 48)" in codec.damage(_jpeg(), "MJPG", 640, 480)


def test_event_and_control_structures_have_the_documented_sizes() -> None:
    assert ctypes.sizeof(codec.Event) == 136
    assert ctypes.sizeof(codec.ExtendedControl) == 20
    assert ctypes.sizeof(codec.Format) == 208
