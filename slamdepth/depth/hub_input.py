# SPDX-License-Identifier: Apache-2.0
"""From an image to the input of a published depth model, as its ``preprocessor_config.json`` says.

The same as the image processors of transformers do, without torchvision, which those of some models need, and
without their rounding of resized images to 8 bits. Depth Anything gets the input size of its authors.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from slamdepth.errors import WeightsError

FILE = "preprocessor_config.json"

_IMAGENET = {"image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
_HALF = {"image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}
_BILINEAR = 2
_DEFAULTS: dict[str, dict[str, Any]] = {
    "depth_anything": {**_IMAGENET, "size": 518, "ensure_multiple_of": 14, "keep_aspect_ratio": True},
    "zoedepth": {
        **_HALF,
        "size": {"height": 384, "width": 512},
        "ensure_multiple_of": 32,
        "keep_aspect_ratio": True,
        "do_pad": True,
        "resample": _BILINEAR,
    },
    "dpt": {**_HALF, "size": 384},
    "glpn": {"do_normalize": False, "size_divisor": 32, "resample": _BILINEAR},
    "depth_pro": {**_HALF, "size": 1536, "resample": _BILINEAR},
    "tipsv2_dpt": {"do_normalize": False, "size": 448, "resample": _BILINEAR},
}
"""What the image processors of these models do unless their file says otherwise."""


@dataclass(frozen=True)
class Prepared:
    """An image as a network takes it.

    Attributes:
        pixels: ``(1, 3, rows, columns)``.
        size: rows and columns that the focal length refers to.
        full: rows and columns that the network's output stands for.
        window: top row, left column, rows and columns of the image in ``full``.
    """

    pixels: torch.Tensor
    size: tuple[int, int]
    full: tuple[int, int]
    window: tuple[int, int, int, int]


@dataclass(frozen=True)
class InputRule:
    """How an image becomes the input of a network.

    Attributes:
        size: rows and columns; None for an image's own.
        fit: ``"squeeze"`` the image to ``size``, or keep its aspect: ``"nearest"`` lets the side decide that
            changes less, ``"cover"`` the one that makes both sides at least those of ``size``.
        multiple: sides are multiples of this.
        pad_to: sides are filled up with zeros to multiples of this; 1 fills nothing.
        reflects: whether the image is surrounded by its reflection before it is resized (ZoeDepth).
        mode: ``"bilinear"`` or ``"bicubic"``.
        antialias: whether shrinking averages.
        scale: factor on values of 0 to 255.
        mean, std: of the scaled values, for each channel.
    """

    size: tuple[int, int] | None
    fit: Literal["squeeze", "nearest", "cover"] = "squeeze"
    multiple: int = 1
    pad_to: int = 1
    reflects: bool = False
    mode: str = "bicubic"
    antialias: bool = True
    scale: float = 1 / 255
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)

    def size_of(self, height: int, width: int, native: tuple[int, int] | None = None) -> tuple[int, int]:
        """Rows and columns that a ``height`` x ``width`` image is resized to.

        Args:
            height: rows of the image.
            width: columns of the image.
            native: where the rule leaves the size open, the area of this is taken, at the image's aspect.
        """
        if self.size is None:
            scale = 1.0 if native is None else math.sqrt(native[0] * native[1] / (height * width))
            sides = (round(height * scale), round(width * scale))
            rows, columns = (max(1, side // self.multiple) * self.multiple for side in sides)
            return rows, columns
        down, across = self.size[0] / height, self.size[1] / width
        if self.fit == "nearest":
            down = across = across if abs(1 - across) < abs(1 - down) else down
        elif self.fit == "cover":
            down = across = max(down, across)
        sides_px = (down * height, across * width)
        rows, columns = (max(1, round(side / self.multiple)) * self.multiple for side in sides_px)
        return rows, columns

    def prepare(
        self, image_rgb: NDArray[np.uint8], native: tuple[int, int] | None, device: str = "cpu"
    ) -> Prepared:
        """An RGB image ``(H, W, 3)`` as the network's input; ``native`` as for :meth:`size_of`."""
        height, width = image_rgb.shape[:2]
        pixels = torch.from_numpy(np.ascontiguousarray(image_rgb)).to(device).permute(2, 0, 1)[None]
        pixels = pixels.float() * self.scale
        full, window = (height, width), (0, 0, height, width)
        if self.reflects:
            down, across = (int(math.sqrt(side / 2) * 3) for side in (height, width))
            pixels = F.pad(pixels, (across, across, down, down), mode="reflect")
            full, window = (height + 2 * down, width + 2 * across), (down, across, height, width)
        rows, columns = self.size_of(*full, native)
        if (rows, columns) != full:
            how: dict[str, Any] = {"align_corners": True} if self.reflects else {"antialias": self.antialias}
            pixels = F.interpolate(pixels, size=(rows, columns), mode=self.mode, **how)
        mean, std = (torch.tensor(values, device=device).view(1, 3, 1, 1) for values in (self.mean, self.std))
        pixels = (pixels - mean) / std
        if rows % self.pad_to or columns % self.pad_to:
            down, across = -rows % self.pad_to, -columns % self.pad_to
            left, top = across // 2, down // 2
            pixels = F.pad(pixels, (left, across - left, top, down - top))
            full, window = (rows + down, columns + across), (top, left, rows, columns)
        return Prepared(pixels.contiguous(), (rows, columns), full, window)


def restored(values: torch.Tensor, prepared: Prepared, height: int, width: int) -> torch.Tensor:
    """A network's output ``(1, rows, columns)`` as a map ``(height, width)`` of the image it was given."""
    top, left, rows, columns = prepared.window
    out = F.interpolate(values[:, None].float(), size=prepared.full, mode="bilinear", align_corners=False)
    out = out[:, :, top : top + rows, left : left + columns]
    if (rows, columns) != (height, width):
        out = F.interpolate(out, size=(height, width), mode="bilinear", align_corners=False)
    return out[0, 0]


def read_rule(folder: Path, model_type: str) -> InputRule:
    """The rule of the model in ``folder``, or that of its type where it has no ``preprocessor_config.json``.

    Raises:
        WeightsError: the file is absent and the type has no rule, or it is not readable.
    """
    path = folder / FILE
    values = dict(_DEFAULTS.get(model_type, {}))
    if path.is_file():
        try:
            loaded = json.loads(path.read_text(encoding="utf-8"))
            return rule_of({**values, **loaded}, model_type)
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise WeightsError(
                f"{path}: not readable as the settings of an image processor: {error}"
            ) from error
    if not values:
        raise WeightsError(f"{folder}: has no {FILE}, which says how images are prepared")
    return rule_of(values, model_type)


def usual_rule(model_type: str) -> InputRule:
    """The rule of a type of model whose files say nothing else."""
    return rule_of(_DEFAULTS[model_type], model_type)


def rule_of(values: dict[str, Any], model_type: str) -> InputRule:
    """The rule that the settings of an image processor describe.

    Raises:
        ValueError, TypeError, KeyError: they describe none.
    """
    size = values.get("size") if values.get("do_resize", True) and model_type != "glpn" else None
    if isinstance(size, dict):
        size = (int(size["height"]), int(size["width"]))
    elif size is not None:
        size = (int(size), int(size))
    divisor = int(values.get("size_divisor") or 1)
    pads = bool(values.get("do_pad", False))
    reflects = model_type == "zoedepth" and pads
    normalises = values.get("do_normalize", True)
    mean, std = (tuple(float(v) for v in values.get(key, ())) for key in ("image_mean", "image_std"))
    if normalises and (len(mean), len(std)) != (3, 3):
        raise ValueError("image_mean and image_std must be three numbers each")
    # The authors of Depth Anything keep the short side at 518 pixels or more; transformers may shrink it.
    fit: Literal["nearest", "cover"] = "cover" if model_type == "depth_anything" else "nearest"
    rule = InputRule(
        size,
        fit=fit if values.get("keep_aspect_ratio", False) else "squeeze",
        multiple=divisor if model_type == "glpn" else int(values.get("ensure_multiple_of") or 1),
        pad_to=divisor if pads and not reflects and model_type != "glpn" else 1,
        reflects=reflects,
        mode="bilinear" if values.get("resample") == _BILINEAR else "bicubic",
        antialias=model_type != "depth_pro",
        scale=float(values.get("rescale_factor", 1 / 255)) if values.get("do_rescale", True) else 1.0,
        mean=mean if normalises else (0.0, 0.0, 0.0),
        std=std if normalises else (1.0, 1.0, 1.0),
    )
    if min(*(rule.size or (1, 1)), rule.multiple, rule.pad_to) < 1 or min(rule.std) <= 0:
        raise ValueError("sizes and deviations must be positive")
    return rule
