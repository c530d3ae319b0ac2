# SPDX-License-Identifier: Apache-2.0
"""Keyframes as small images: the colour image, its depth in colour, and the sensor's where there is one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.report.page import data_address

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.mapping.keyframe import Keyframe

NEAR_TO_FAR = ("#0b1457", "#17458f", "#11787f", "#2f9e4f", "#98c83a", "#fbe743")
"""Depth from near (dark blue) over green to far (yellow), evenly spaced."""

UNKNOWN = "#808080"
_WIDTH_PX = 320


@dataclass(frozen=True)
class KeyframeImages:
    """Images of one keyframe.

    Attributes:
        id: number of the keyframe.
        seconds: since the first keyframe.
        images: a ``data:`` address for each name: ``image``, ``depth``, where it was measured ``depth
            from many views`` and, unless the depth is a sensor's or there is none, ``sensor depth``.
    """

    id: int
    seconds: float
    images: dict[str, str]


@dataclass(frozen=True)
class Gallery:
    """Images of some keyframes under one colour scale from ``near_m`` to ``far_m`` metres."""

    keyframes: tuple[KeyframeImages, ...]
    near_m: float
    far_m: float

    @property
    def is_wide(self) -> bool:
        """True where a keyframe has more than its image and one depth map."""
        return any(len(keyframe.images) > 2 for keyframe in self.keyframes)


def colour_depth(
    depth_m: NDArray[np.floating], near_m: float, far_m: float, known: NDArray[np.bool_] | None = None
) -> NDArray[np.uint8]:
    """Colours ``(H, W, 3)`` uint8 RGB of a depth map.

    Args:
        depth_m: ``(H, W)`` metres. Values of another unit are coloured in the same way.
        near_m, far_m: drawn dark blue and yellow. ``near_m`` may be the larger one (inverse depth).
        known: ``(H, W)``, which pixels have a value; the others are grey. Default: finite and above 0.
    """
    anchors = np.array([rgb_of(colour) for colour in NEAR_TO_FAR], dtype=np.float64)
    if known is None:
        known = np.isfinite(depth_m) & (depth_m > 0)
    span = far_m - near_m if abs(far_m - near_m) > 1e-9 else 1e-9
    position = np.clip((np.where(known, depth_m, near_m) - near_m) / span, 0.0, 1.0)
    levels = np.linspace(0.0, 1.0, len(anchors))
    table_at = np.linspace(0.0, 1.0, 256)
    channels = [np.interp(table_at, levels, channel).round() for channel in anchors.T]
    coloured = np.stack(channels, axis=1).astype(np.uint8)[np.round(position * 255).astype(np.int64)]
    coloured[~known] = rgb_of(UNKNOWN)
    return coloured


def near_to_far() -> Any:
    """The colours of :func:`colour_depth` as a matplotlib colour map."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("near to far", NEAR_TO_FAR).with_extremes(bad=UNKNOWN)


def keyframe_gallery(keyframes: tuple[Keyframe, ...], count: int = 4) -> Gallery | None:
    """Images of ``count`` keyframes spread evenly over the run; None where there are no keyframes."""
    if not keyframes:
        return None
    spread = np.linspace(0, len(keyframes) - 1, count).round().astype(int)
    chosen = [keyframes[i] for i in sorted(set(spread.tolist()))]
    known = np.concatenate([d[np.isfinite(d) & (d > 0)][::16] for d in (k.load_depth_m() for k in chosen)])
    near_m, far_m = (float(v) for v in np.percentile(known, (1, 98))) if len(known) else (0.0, 1.0)
    start_s = keyframes[0].frame.timestamp_s
    return Gallery(tuple(_images_of(k, start_s, near_m, far_m) for k in chosen), near_m, far_m)


def _images_of(keyframe: Keyframe, start_s: float, near_m: float, far_m: float) -> KeyframeImages:
    frame = keyframe.frame.load()
    images = {
        "image": _small(frame.image_rgb, smooth=True),
        "depth": _small(colour_depth(keyframe.load_depth_m(), near_m, far_m), smooth=False),
    }
    if keyframe.dense is not None:
        dense_m = keyframe.dense.load().depth_m
        images["depth from many views"] = _small(colour_depth(dense_m, near_m, far_m), smooth=False)
    sensor_m = None if keyframe.prediction.is_sensor else frame.depth_m
    if sensor_m is not None:
        images["sensor depth"] = _small(colour_depth(sensor_m, near_m, far_m), smooth=False)
    return KeyframeImages(keyframe.id, frame.timestamp_s - start_s, images)


def _small(image_rgb: NDArray[np.uint8], *, smooth: bool) -> str:
    import cv2

    height, width = image_rgb.shape[:2]
    size = (_WIDTH_PX, max(1, round(height * _WIDTH_PX / width)))
    small = cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA if smooth else cv2.INTER_NEAREST)
    return jpeg_address(np.asarray(small, np.uint8))


def jpeg_address(image_rgb: NDArray[np.uint8]) -> str:
    """The image ``(H, W, 3)`` uint8 RGB as a JPEG in a ``data:`` address."""
    return data_address(encode_jpeg(image_rgb, 84), "image/jpeg")


def encode_jpeg(image_rgb: NDArray[np.uint8], quality: int) -> bytes:
    """The image ``(H, W, 3)`` uint8 RGB as a JPEG file."""
    import cv2

    _, data = cv2.imencode(".jpg", image_rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def rgb_of(colour: str) -> tuple[int, int, int]:
    """The channels of ``#rrggbb``."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)
