# SPDX-License-Identifier: Apache-2.0
"""The embedded default: metric depth and its uncertainty from a frozen DINOv2 ViT-S/14."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import DinoV2, load_dinov2, working_type
from slamdepth.depth.gravity_direction import FRAMES, DownEstimate, Look, find_down
from slamdepth.depth.gravity_field import gravity_field
from slamdepth.depth.head import HeadEnsemble, load_head
from slamdepth.depth.preprocess import (
    CANONICAL_FOCAL_PX,
    check_size,
    focal_px_at,
    input_size,
    normalised,
    resize_rgb,
)
from slamdepth.depth.registry import register
from slamdepth.depth.upright import roll_rad, turned, turned_back
from slamdepth.depth.vanishing import find_lines, manhattan_frames
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo

_TURN_RAD = math.radians(8.0)
"""A look at an image turned by so much less or more serves to find out which way is down."""

_LEVEL_RAD, _ROLLED_RAD = math.radians(4.0), math.radians(12.0)
"""An image rolled by less counts as it was taken, one rolled by more as it is turned upright; between them
the one goes over into the other, so that the depth of a video does not jump."""


@dataclass(frozen=True)
class _Seen:
    """What the backbone says of an image: a look at it, and what else the head reads."""

    look: Look
    class_tokens: torch.Tensor
    image: torch.Tensor
    frame: Frame


class _Looks:
    """A frame as taken and turned upright from rolls, each seen once."""

    def __init__(self, frame: Frame, see: Callable[[Frame, float], _Seen]) -> None:
        self._see, self.as_taken = see, see(frame, 0.0)
        self._seen = [self.as_taken]

    def at(self, roll: float, within_rad: float = _TURN_RAD) -> _Seen:
        """A look in which a camera of this roll is upright to ``within_rad``."""
        for seen in self._seen:
            apart = roll - seen.look.turn_rad
            if abs(math.atan2(math.sin(apart), math.cos(apart))) < within_rad:
                return seen
        frame = self.as_taken.frame
        image = turned(frame.image_rgb, frame.camera, -roll)
        self._seen.append(self._see(replace(frame, image_rgb=image, depth_m=None), roll))
        return self._seen[-1]


class Dinov2Depth:
    """DINOv2 tokens and a small trained head; see ``slamdepth/assets/dinov2_head.md``.

    A head that is told where down is finds it by lines and tokens first; an image that is rolled is then
    turned upright and seen once more.

    Args:
        backbone: a ViT-S/14 in eval mode.
        head: heads that read its tokens.
        weights: what the two were read from.
        device: where both run.
    """

    name = "dinov2"
    kind = DepthKind.METRIC

    def __init__(
        self,
        backbone: DinoV2,
        head: HeadEnsemble,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
    ) -> None:
        self.weights = weights
        self.card = _card(head, weights)
        self.device = device
        self._dtype = working_type(device)
        self._backbone = backbone.to(device, self._dtype)
        self._head = head.to(device)

    @classmethod
    def load(
        cls, *, backbone: Path | None = None, head: Path | None = None, device: str = "cpu"
    ) -> Dinov2Depth:
        """Read the backbone (default: the cached one) and the head (default: the shipped one).

        Raises:
            WeightsError: one line: what is missing or damaged, and what to do.
        """
        head_file = head or store.head_path()
        backbone_file = store.find_backbone(backbone)
        backbone_info = store.backbone_info(backbone_file)
        network, about = load_head(head_file, device)
        infos = (
            backbone_info,
            WeightsInfo(
                head_file.stem,
                sha256_of(head_file),
                about.get("trained_on", "unknown"),
                about.get("licence", "unknown"),
            ),
        )
        return cls(load_dinov2(backbone_file, device), network, infos, device)

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth in metres for every raw (not undistorted) pixel of ``frame``; gravity is found out where the
        frame does not say it.

        Raises:
            CameraError: the image is too small or too narrow for the network.
        """
        check_size(frame)
        looks = _Looks(frame, self._see)
        if frame.gravity is not None:
            return replace(self._upright(looks, frame.gravity), gravity=frame.gravity, gravity_share=1.0)
        if (down := self._down(frame, looks)) is None:
            return self._upright(looks, None)
        return replace(self._upright(looks, down.down), gravity=down.down, gravity_share=down.share)

    def _see(self, frame: Frame, turn_rad: float) -> _Seen:
        height, width = frame.image_rgb.shape[:2]
        rows, columns = input_size(height, width, self._head.shape.input_px)
        image = normalised(resize_rgb(frame.image_rgb, rows, columns)[None], self.device)
        with torch.inference_mode():
            tapped = self._backbone(image.to(self._dtype), self._head.shape.taps)
            tokens = torch.stack([grid for grid, _ in tapped], dim=1).float()
            class_tokens = torch.stack([token for _, token in tapped], dim=1).float()
        focal_px = focal_px_at(frame.camera, rows, columns)
        return _Seen(Look(tokens, (rows, columns), focal_px, turn_rad), class_tokens, image, frame)

    def _down(self, frame: Frame, looks: _Looks) -> DownEstimate | None:
        if self._head.down is None:
            return None
        frames = manhattan_frames(find_lines(frame.image_rgb, frame.camera), FRAMES)
        return find_down(self._head.down, frames, lambda roll: looks.at(roll).look)

    def _upright(self, looks: _Looks, down: NDArray[np.float64] | None) -> DepthPrediction:
        """The prediction of the look in which the camera is upright, given ``down (3,)`` as taken."""
        as_taken = self._told(looks.as_taken, down)
        if down is None:
            return as_taken
        roll = roll_rad(down)
        if (upright := looks.at(roll, _LEVEL_RAD)) is looks.as_taken:
            return as_taken
        told = self._told(upright, upright.look.seen(down))
        share = min(1.0, (abs(roll) - _LEVEL_RAD) / (_ROLLED_RAD - _LEVEL_RAD))
        return turned_back(told, as_taken, upright.frame.camera, upright.look.turn_rad, share)

    def _told(self, seen: _Seen, down: NDArray[np.float64] | None) -> DepthPrediction:
        """The head's prediction, told that gravity points ``down (3,)`` in what was seen."""
        look = seen.look
        with torch.inference_mode():
            field = None
            if down is not None:
                direction = torch.from_numpy(down[None]).float().to(self.device)
                field = gravity_field(
                    direction, torch.tensor([look.focal_px], device=self.device), *look.size
                )
            log_depth, sigma = self._head(look.tokens, seen.class_tokens, seen.image, field)
            both = torch.stack([log_depth, sigma], dim=1)
            size = seen.frame.image_rgb.shape[:2]
            full = F.interpolate(both, size=size, mode="bilinear", align_corners=False)[0]
            log_depth_full = full[0] + math.log(look.focal_px / CANONICAL_FOCAL_PX)
            values = log_depth_full.exp().cpu().numpy()
            sigma_log = full[1].cpu().numpy()
        return DepthPrediction(
            np.ascontiguousarray(values, dtype=np.float32),
            self.kind,
            np.ascontiguousarray(sigma_log, dtype=np.float32),
        )


def _card(head: HeadEnsemble, weights: tuple[WeightsInfo, ...]) -> ModelCard:
    """What the head learnt from; its training images are brought to one focal length."""
    about = weights[-1] if weights else WeightsInfo("none", "", "unknown", "unknown")
    size = input_size(3, 4, head.shape.input_px)
    return ModelCard("dinov2", DepthKind.METRIC, size, CANONICAL_FOCAL_PX, about.licence, about.trained_on)


@register("dinov2")
def create(*, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> Dinov2Depth:
    """The model with the cached backbone and the head in ``weights``, by default the shipped one.

    It has nothing random.
    """
    del seed
    return Dinov2Depth.load(head=weights, device=device)
