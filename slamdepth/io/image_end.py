# SPDX-License-Identifier: Apache-2.0
"""Detection of truncated PNG and JPEG files, also where a camera has appended data to the image."""

from __future__ import annotations

import re

_PNG_START = b"\x89PNG\r\n\x1a\n"
_PNG_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_JPEG_START = b"\xff\xd8\xff"
_JPEG_END = 0xD9
# Inside a scan 0xff is escaped by a zero or begins a restart marker; neither has a length, nor do the
# other markers left out here.
_JPEG_SEGMENT = re.compile(rb"\xff[^\x00\x01\xd0-\xd8\xff]")


def is_cut_short(data: bytes) -> bool:
    """True for the bytes of a PNG or JPEG that end before its first image does; False for other formats.

    OpenCV fills the missing rows of such an image with grey, without an error.
    """
    if data.startswith(_PNG_START):
        # Always, as OpenCV reserves memory for what a damaged chunk says of its length.
        return not _has_png_end(data)
    return data.startswith(_JPEG_START) and not _has_jpeg_end(data)


def _has_png_end(data: bytes) -> bool:
    """Walk the chunks, each of length, type, content and check sum, up to the last one."""
    start = len(_PNG_START)
    while start + len(_PNG_END) <= len(data):
        if data[start + 4 : start + 8] == b"IEND":
            return True
        start += len(_PNG_END) + int.from_bytes(data[start : start + 4], "big")
    return False


def _has_jpeg_end(data: bytes) -> bool:
    """Walk the markers; the content of a segment, such as the JPEG of a thumbnail, is skipped."""
    start = 2
    while (found := _JPEG_SEGMENT.search(data, start)) is not None:
        if data[found.end() - 1] == _JPEG_END:
            return True
        start = found.end() + int.from_bytes(data[found.end() : found.end() + 2], "big")
    return False
