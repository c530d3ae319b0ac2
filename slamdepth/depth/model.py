# SPDX-License-Identifier: Apache-2.0
"""The embedded default: metric depth and its uncertainty from a frozen DINOv2 ViT-S/14."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import DinoV2, load_dinov2, working_type
from slamdepth.depth.gravity_direction import FRAMES, EncodedImage, GravityEstimate, estimate_gravity
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
from slamdepth.depth.upright import roll_rad, rotated, rotated_back
from slamdepth.depth.vanishing import find_lines, manhattan_frames
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo
from slamdepth.typing import Floats

_SAME_ROLL_RAD = math.radians(8.0)
"""To score directions of gravity, an image rotated by so much less or more than asked for serves as well."""

_UPRIGHT_RAD, _ROLLED_RAD = math.radians(4.0), math.radians(12.0)
"""An image rolled by less than the first is predicted as taken, one rolled by more than the second as rotated
upright. Between them the two predictions are blended, so that the depth of a video does not jump."""


@dataclass(frozen=True)
class _Encoded:
    """All that the head reads of an image.

    Attributes:
        image: tokens, input size and focal length.
        class_tokens: ``(1, taps, dim)``.
        pixels: ``(1, 3, rows, columns)``, ImageNet-normalised.
        frame: the image at its own size, and its camera.
    """

    image: EncodedImage
    class_tokens: torch.Tensor
    pixels: torch.Tensor
    frame: Frame


class _Rotations:
    """A frame as taken and rotated upright from several rolls; each rotation is encoded once.

    Args:
        frame: as taken.
        encode: runs the backbone on a frame; the roll in radians that was undone is passed on.
    """

    def __init__(self, frame: Frame, encode: Callable[[Frame, float], _Encoded]) -> None:
        self._encode, self.as_taken = encode, encode(frame, 0.0)
        self._encoded = [self.as_taken]

    def upright_from(self, roll: float, within_rad: float = _SAME_ROLL_RAD) -> _Encoded:
        """The image in which a camera of this ``roll``, in radians, is upright to ``within_rad``."""
        for encoded in self._encoded:
            apart = roll - encoded.image.roll_rad
            if abs(math.atan2(math.sin(apart), math.cos(apart))) < within_rad:
                return encoded
        frame = self.as_taken.frame
        image = rotated(frame.image_rgb, frame.camera, -roll)
        self._encoded.append(self._encode(replace(frame, image_rgb=image, depth_m=None), roll))
        return self._encoded[-1]


class Dinov2Depth:
    """DINOv2 tokens and a small trained head; see ``slamdepth/assets/dinov2_head.md``.

    Where the head reads gravity, its direction is estimated first, from lines and tokens, unless the frame
    has it. An image that is rolled is then rotated upright and encoded once more.

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
        """Depth in metres for every raw (not undistorted) pixel of ``frame``.

        Gravity is estimated where the frame does not have it.

        Raises:
            CameraError: the image is too small or too narrow for the network.
        """
        check_size(frame)
        rotations = _Rotations(frame, self._encode)
        if frame.gravity is not None:
            return replace(self._upright(rotations, frame.gravity), gravity=frame.gravity, gravity_share=1.0)
        if (found := self._gravity(frame, rotations)) is None:
            return self._upright(rotations, None)
        return replace(
            self._upright(rotations, found.gravity), gravity=found.gravity, gravity_share=found.share
        )

    def _encode(self, frame: Frame, roll: float) -> _Encoded:
        height, width = frame.image_rgb.shape[:2]
        rows, columns = input_size(height, width, self._head.shape.input_px)
        pixels = normalised(resize_rgb(frame.image_rgb, rows, columns)[None], self.device)
        with torch.inference_mode():
            tapped = self._backbone(pixels.to(self._dtype), self._head.shape.taps)
            tokens = torch.stack([grid for grid, _ in tapped], dim=1).float()
            class_tokens = torch.stack([token for _, token in tapped], dim=1).float()
        focal_px = focal_px_at(frame.camera, rows, columns)
        image = EncodedImage(tokens, (rows, columns), focal_px, roll)
        return _Encoded(image, class_tokens, pixels, frame)

    def _gravity(self, frame: Frame, rotations: _Rotations) -> GravityEstimate | None:
        if self._head.gravity is None:
            return None
        frames = manhattan_frames(find_lines(frame.image_rgb, frame.camera), FRAMES)
        return estimate_gravity(self._head.gravity, frames, lambda roll: rotations.upright_from(roll).image)

    def _upright(self, rotations: _Rotations, gravity: Floats | None) -> DepthPrediction:
        """The prediction of the rotation in which the camera is upright; ``gravity (3,)`` is as taken."""
        as_taken = self._predict(rotations.as_taken, gravity)
        if gravity is None:
            return as_taken
        roll = roll_rad(gravity)
        if (upright := rotations.upright_from(roll, _UPRIGHT_RAD)) is rotations.as_taken:
            return as_taken
        prediction = self._predict(upright, upright.image.rotated(gravity))
        share = min(1.0, (abs(roll) - _UPRIGHT_RAD) / (_ROLLED_RAD - _UPRIGHT_RAD))
        return rotated_back(prediction, as_taken, upright.frame.camera, upright.image.roll_rad, share)

    def _predict(self, encoded: _Encoded, gravity: Floats | None) -> DepthPrediction:
        """The head's prediction; ``gravity (3,)`` is in the frame of the encoded image."""
        image = encoded.image
        with torch.inference_mode():
            field = None
            if gravity is not None:
                direction = torch.from_numpy(gravity[None]).float().to(self.device)
                field = gravity_field(
                    direction, torch.tensor([image.focal_px], device=self.device), *image.size
                )
            focal_px = torch.tensor([image.focal_px], device=self.device)
            log_depth, sigma, scale_sigma = self._head(
                image.tokens, encoded.class_tokens, encoded.pixels, field, focal_px
            )
            both = torch.stack([log_depth, sigma], dim=1)
            size = encoded.frame.image_rgb.shape[:2]
            full = F.interpolate(both, size=size, mode="bilinear", align_corners=False)[0]
            log_depth_full = full[0] + math.log(image.focal_px / CANONICAL_FOCAL_PX)
            values = log_depth_full.exp().cpu().numpy()
            sigma_log = full[1].cpu().numpy()
        return DepthPrediction(
            np.ascontiguousarray(values, dtype=np.float32),
            self.kind,
            np.ascontiguousarray(sigma_log, dtype=np.float32),
            scale_sigma_log=None if scale_sigma is None else float(scale_sigma[0]),
        )


def _card(head: HeadEnsemble, weights: tuple[WeightsInfo, ...]) -> ModelCard:
    """The card of a head; its training images were brought to one focal length."""
    about = weights[-1] if weights else WeightsInfo("none", "", "unknown", "unknown")
    size = input_size(3, 4, head.shape.input_px)
    return ModelCard("dinov2", DepthKind.METRIC, size, CANONICAL_FOCAL_PX, about.licence, about.trained_on)


@register("dinov2")
def create(*, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> Dinov2Depth:
    """The model with the cached backbone and the head in ``weights``, by default the shipped one.

    Nothing in it is random: ``seed`` has no effect.
    """
    del seed
    return Dinov2Depth.load(head=weights, device=device)
