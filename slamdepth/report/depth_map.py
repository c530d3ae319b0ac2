# SPDX-License-Identifier: Apache-2.0
"""Depth maps as colour images: dark blue near, green, yellow far, above a scale bar."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.report.keyframe_images import UNKNOWN, colour_depth, rgb_of
from slamdepth.types import DepthKind
from slamdepth.typing import Bools

if TYPE_CHECKING:
    from numpy.typing import NDArray

RELATIVE = "relative, no unit"
_INK, _MUTED, _PAPER = "#14181f", "#5b6575", "#ffffff"
_STEPS = (1.0, 2.0, 2.5, 5.0)
_TICKS = 7


@dataclass(frozen=True)
class Scale:
    """What the colours of a depth map stand for.

    Attributes:
        near, far: the values drawn dark blue and yellow; metres where ``kind`` is METRIC, otherwise
            without unit. Of inverse depth, ``near`` is the larger one.
        kind: what the values mean.
        caution: a few words below the bar, such as what the metres rest on.
    """

    near: float
    far: float
    kind: DepthKind
    caution: str = ""


def known_pixels(values: NDArray[np.floating], kind: DepthKind) -> Bools:
    """``(H, W)``, where a map has a value.

    In metres 0 is unknown. Without unit every finite number is a value, 0 too.
    """
    finite: Bools = np.isfinite(values)
    return finite & (values > 0) if kind is DepthKind.METRIC else finite


def value_range(values: NDArray[np.floating], kind: DepthKind) -> tuple[float, float] | None:
    """Near and far end of a map ``(H, W)``, the outermost hundredths cut off; None without values."""
    known = values[known_pixels(values, kind)]
    if len(known) == 0:
        return None
    low, high = (float(value) for value in np.percentile(known, (1, 99)))
    return (high, low) if kind is DepthKind.AFFINE_INVERSE_DEPTH else (low, high)


def coloured(values: NDArray[np.floating], scale: Scale) -> NDArray[np.uint8]:
    """A map ``(H, W)`` as colours ``(H, W, 3)`` uint8 RGB, grey where unknown."""
    return colour_depth(values, scale.near, scale.far, known_pixels(values, scale.kind))


def depth_map_image(values: NDArray[np.floating], scale: Scale) -> NDArray[np.uint8]:
    """A map ``(H, W)`` in colour with the scale bar below it, ``(H + h, W, 3)`` uint8 RGB."""
    return np.concatenate([coloured(values, scale), scale_bar(values.shape[1], scale)])


def side_by_side(
    image_rgb: NDArray[np.uint8], values: NDArray[np.floating], scale: Scale, max_width: int = 960
) -> NDArray[np.uint8]:
    """An image ``(H, W, 3)`` and its map ``(H, W)`` side by side, above one scale bar, uint8 RGB.

    Each is at most ``max_width`` pixels wide. Height and width are even, as video codecs require.
    """
    import cv2

    height, width = image_rgb.shape[:2]
    factor = min(1.0, max_width / width)
    size = (2 * max(1, round(width * factor / 2)), 2 * max(1, round(height * factor / 2)))
    colours = coloured(values, scale)
    if size != (width, height):
        image_rgb = np.asarray(cv2.resize(image_rgb, size, interpolation=cv2.INTER_AREA), np.uint8)
        colours = np.asarray(cv2.resize(colours, size, interpolation=cv2.INTER_AREA), np.uint8)
    gap = np.full((size[1], 4, 3), rgb_of(_PAPER), np.uint8)
    pair = np.concatenate([image_rgb, gap, colours], axis=1)
    image = np.concatenate([pair, scale_bar(pair.shape[1], scale)])
    return image if len(image) % 2 == 0 else np.concatenate([image, image[-1:]])


def nice_ticks(low: float, high: float, most: int = _TICKS) -> list[float]:
    """Round numbers from ``low`` to ``high``, evenly spaced, at most ``most`` of them."""
    if not high > low:
        return [low]
    rough = (high - low) / most
    magnitude = 10.0 ** math.floor(math.log10(rough))
    step = next(s * magnitude for s in (*_STEPS, 10.0, 20.0) if _count(low, high, s * magnitude) <= most)
    first = math.ceil(low / step - 1e-9)
    return [(first + k) * step for k in range(_count(low, high, step))]


def _count(low: float, high: float, step: float) -> int:
    return math.floor(high / step + 1e-9) - math.ceil(low / step - 1e-9) + 1


@lru_cache(maxsize=64)
def scale_bar(width: int, scale: Scale) -> NDArray[np.uint8]:
    """The strip ``(h, width, 3)`` RGB below a depth map: bar, ticks and unit, and what grey means.

    Metres are named only where the values are metric.
    """
    from PIL import Image, ImageDraw, ImageFont

    size = min(max(11, round(width * 0.024)), 44)
    font = ImageFont.load_default(size)
    pad, bar_height = max(4, round(0.7 * size)), max(6, round(0.9 * size))
    is_metric = scale.kind is DepthKind.METRIC
    title = "depth (m)" if is_metric else "depth"
    strip = Image.new("RGB", (width, 2 * pad + bar_height + round(1.9 * size)), _PAPER)
    draw = ImageDraw.Draw(strip)

    def length(text: str) -> int:
        return math.ceil(draw.textlength(text, font=font))

    left, right = pad, width - pad
    middle_y = pad + bar_height // 2
    # In an image too narrow for all words, the bar and its numbers come first.
    if length(title) + 2 * pad < 0.35 * width:
        draw.text((left, middle_y), title, font=font, fill=_INK, anchor="lm")
        left += length(title) + pad
    unknown = "unknown"
    if length(unknown) + bar_height + 2 * pad < 0.35 * width:
        draw.text((right, middle_y), unknown, font=font, fill=_MUTED, anchor="rm")
        swatch = right - length(unknown) - size // 2 - bar_height
        draw.rectangle((swatch, pad, swatch + bar_height - 1, pad + bar_height - 1), fill=UNKNOWN)
        right = swatch - pad
    _draw_bar(strip, left, right, pad, bar_height)
    base_y = pad + bar_height
    if is_metric:
        _draw_ticks(draw, font, scale, left, right, base_y, size)
    else:
        draw.text((left, base_y + size // 4), "near", font=font, fill=_INK, anchor="la")
        draw.text((right, base_y + size // 4), "far", font=font, fill=_INK, anchor="ra")
        if length("near far") + length(RELATIVE) + 2 * pad < right - left:
            draw.text(((left + right) / 2, base_y + size // 4), RELATIVE, font=font, fill=_MUTED, anchor="ma")
    if scale.caution:
        strip = _with_caution(strip, scale.caution, size, pad)
    pixels = np.array(strip, dtype=np.uint8)
    pixels.setflags(write=False)
    return pixels


def _draw_bar(strip: Any, left: int, right: int, top: int, height: int) -> None:
    """The colours from near to far, in the pixels ``left`` to ``right``."""
    from PIL import Image

    columns = max(2, right - left)
    gradient = colour_depth(np.linspace(1.0, 2.0, columns)[None], 1.0, 2.0)
    strip.paste(Image.fromarray(np.repeat(gradient, height, axis=0)), (left, top))


def _draw_ticks(draw: Any, font: Any, scale: Scale, left: int, right: int, top: int, size: int) -> None:
    span = max(scale.far - scale.near, 1e-9)
    most = int(min(_TICKS, max(1, (right - left) / (3.6 * size))))
    ticks = nice_ticks(scale.near, scale.far, most)
    digits = max((len(f"{tick:.6g}".partition(".")[2]) for tick in ticks), default=0)
    for tick in ticks:
        x = left + (right - left - 1) * (tick - scale.near) / span
        draw.line((x, top, x, top + size // 4), fill=_INK, width=max(1, size // 12))
        text = f"{tick:.{digits}f}"
        half = draw.textlength(text, font=font) / 2
        draw.text(
            (min(max(x, half), 2 * right - half), top + size // 3), text, font=font, fill=_INK, anchor="ma"
        )


def _with_caution(strip: Any, words: str, size: int, pad: int) -> Any:
    """The strip with a line of small print below it, where that fits."""
    from PIL import Image, ImageDraw, ImageFont

    small = max(9, round(0.78 * size))
    font = ImageFont.load_default(small)
    if ImageDraw.Draw(strip).textlength(words, font=font) > strip.width - 2 * pad:
        return strip
    taller = Image.new("RGB", (strip.width, strip.height + small + pad // 2), _PAPER)
    taller.paste(strip, (0, 0))
    ImageDraw.Draw(taller).text((pad, strip.height - pad // 2), words, font=font, fill=_MUTED, anchor="la")
    return taller
