# SPDX-License-Identifier: Apache-2.0
"""Live sources: ``camera:N``, and addresses of RTSP, HTTP and HTTPS."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from slamdepth.datasets.addresses import address_of, is_address, without_secret
from slamdepth.datasets.live import LiveCapture, LiveSequence
from slamdepth.datasets.options import ReadOptions
from slamdepth.datasets.recording import camera_for
from slamdepth.datasets.registry import register_reader
from slamdepth.types import Camera

_CAMERA = re.compile(r"camera:(\d{1,3})")


@register_reader
class LiveReader:
    """Opens live sources."""

    name = "live"
    needs = "camera:0, or an address rtsp://, http:// or https://"

    def matches(self, path: Path) -> bool:
        return _CAMERA.fullmatch(str(path)) is not None or is_address(str(path))

    def open(self, path: Path, camera: Camera | None) -> LiveSequence:
        return self.open_with(path, camera, ReadOptions())

    def open_with(self, path: Path, camera: Camera | None, options: ReadOptions) -> LiveSequence:
        text = str(path)
        number = _CAMERA.fullmatch(text)
        if number:
            capture = LiveCapture(int(number[1]), text, options.stall_s)
        else:
            capture = LiveCapture(address_of(text), without_secret(text), options.stall_s)
        try:
            shape = (capture.height, capture.width, 3)
            taken_by, source = camera_for(Path(capture.name), shape, camera, None, "")
        except BaseException:
            capture.close()
            raise
        name = re.sub(r"[^\w.-]+", "-", capture.name).strip("-.")[:60] or "live"
        return LiveSequence(name, capture, replace(taken_by, fps=capture.fps), source, options.seconds)
