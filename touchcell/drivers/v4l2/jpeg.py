"""Whether a JPEG is complete and undamaged, as far as a decoder could notice (ITU-T T.81, baseline).

Decoders such as OpenCV's fill the rest of a picture with grey where its scan is damaged, and report nothing. Here the
Huffman code of the scan is read to its end, without decoding pixels. JPEG has no checksum: a damaged bit that still
gives a valid code of the same length is not detectable. Without the C extension only the markers are checked.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from touchcell.compiled import extension

_compiled = extension("touchcell.drivers.v4l2._jpegc")

_OTHER_PROCESS = 11
_REASONS: Mapping[int, str] = MappingProxyType(
    {
        1: "no start of image",
        2: "no marker where one has to be",
        3: "a segment is cut short",
        4: "no scan",
        5: "an impossible Huffman table",
        6: "an impossible frame header",
        7: "an invalid Huffman code in the scan",
        8: "truncated: the scan ends before the picture",
        9: "a restart marker is missing",
        10: "more data than the picture needs",
    }
)


def damage(data: bytes, width: int, height: int) -> str:
    """Return why ``data`` is not a complete picture of that size, or "" if it looks complete.

    Bytes after the end of the picture are padding, whatever they are, as decoders ignore them. A progressive picture
    is checked by its markers only.
    """
    if _compiled is None:
        return _marker_damage(data, width, height)
    problem, *size = _compiled.check(data)
    if problem == _OTHER_PROCESS:
        return _marker_damage(data, width, height)
    if problem:
        return _REASONS[problem]
    return "" if (size[0], size[1]) == (width, height) else f"size is {tuple(size)} instead of {(width, height)}"


def _marker_damage(data: bytes, width: int, height: int) -> str:
    if data[:2] != b"\xff\xd8":
        return _REASONS[1]
    at = 2
    size: tuple[int, int] | None = None
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            return _REASONS[2]
        marker = data[at + 1]
        if marker == 0xFF:
            at += 1
            continue
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if marker == 0xDA:
            # The end marker cannot occur within a scan, where 0xFF is followed by 0.
            if data.find(b"\xff\xd9", at + 2 + length) < 0:
                return _REASONS[8]
            return "" if size == (width, height) else f"size is {size} instead of {(width, height)}"
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            size = (int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big"))
        if length < 2:
            return _REASONS[3]
        at += 2 + length
    return _REASONS[4]
