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

from slamdepth.config import Precision
from slamdepth.depth import weights as store
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import DinoV2, load_dinov2
from slamdepth.depth.gravity_direction import FRAMES, EncodedImage, GravityEstimate, estimate_gravity
from slamdepth.depth.gravity_field import gravity_field
from slamdepth.depth.head import HeadEnsemble, load_head
from slamdepth.depth.precision import chosen_precision, with_precision
from slamdepth.depth.preprocess import (
    CANONICAL_FOCAL_PX,
    check_size,
    input_size,
    normalised,
    resize_rgb,
)
from slamdepth.depth.registry import register
from slamdepth.depth.upright import UprightView, roll_rad
from slamdepth.depth.vanishing import find_lines, manhattan_frames
from slamdepth.depth.wide_view import middle_view, with_scale_of
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo
from slamdepth.typing import Floats

_SAME_ROLL_RAD = math.radians(8.0)
"""To score directions of gravity, an image rotated by so much less or more than asked for serves as well."""

_UPRIGHT_RAD = math.radians(12.0)
"""An image rolled by less is predicted as taken: rotated upright it is predicted no better."""


@dataclass(frozen=True)
class _Encoded:
    """All that the head reads of an image.

    Attributes:
        image: tokens, input size and focal length.
        class_tokens: ``(1, taps, dim)``.
        pixels: ``(1, 3, rows, columns)``, ImageNet-normalised.
        size: rows and columns of the image that was resized to the network's input.
        view: how that image was rotated upright; None for the image as taken.
    """

    image: EncodedImage
    class_tokens: torch.Tensor
    pixels: torch.Tensor
    size: tuple[int, int]
    view: UprightView | None = None


class _Rotations:
    """A frame as taken and rotated upright from several rolls; each rotation is encoded once.

    Args:
        encode: runs the backbone on a frame, rotated upright from a roll in radians.
    """

    def __init__(self, encode: Callable[[float], _Encoded]) -> None:
        self._encode = encode
        self._encoded: list[_Encoded] = []

    def upright_from(self, roll: float, within_rad: float = _SAME_ROLL_RAD) -> _Encoded:
        """The image in which a camera of this ``roll``, in radians, is upright to ``within_rad``."""
        for encoded in self._encoded:
            apart = roll - encoded.image.roll_rad
            if abs(math.atan2(math.sin(apart), math.cos(apart))) < within_rad:
                return encoded
        self._encoded.append(self._encode(0.0 if abs(roll) < within_rad else roll))
        return self._encoded[-1]


class Dinov2Depth:
    """DINOv2 tokens and a small trained head; see ``slamdepth/assets/dinov2_head.md``.

    An image that is rolled is rotated upright. Where the frame has gravity, or a guess of it, that takes one
    pass of the backbone; else gravity is estimated first, from lines and the tokens of at most three
    rotations.

    Args:
        backbone: a ViT-S/14 in eval mode. Adapters of the head are added to its weights.
        head: heads that read its tokens.
        weights: what the two were read from, in this order.
        device: where both run.
        precision: what the backbone computes in. int8 and bfloat16 change it in place.
        input_px: rows times columns of the input; None: as the head was trained. The network predicts the
            same depth for the same view in other pixels, so the focal length counts in pixels of the
            trained size.
    """

    name = "dinov2"
    kind = DepthKind.METRIC

    def __init__(
        self,
        backbone: DinoV2,
        head: HeadEnsemble,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
        precision: Precision = "auto",
        input_px: int | None = None,
    ) -> None:
        chosen = chosen_precision(precision, device)
        self.weights = (*(replace(info, precision=chosen) for info in weights[:1]), *weights[1:])
        self.card = _card(head, weights)
        self.device = device
        if head.adapters is not None:
            head.adapters.merge_into(backbone)
        self._backbone, self._dtype = with_precision(backbone, chosen, device)
        self._head = head.to(device)
        self._input_px = input_px or head.shape.input_px
        self._to_trained_px = math.sqrt(head.shape.input_px / self._input_px)

    @classmethod
    def load(
        cls,
        *,
        backbone: Path | None = None,
        head: Path | None = None,
        device: str = "cpu",
        precision: Precision = "auto",
        input_px: int | None = None,
    ) -> Dinov2Depth:
        """Read the backbone (default: the cached one) and the head (default: the shipped one).

        Raises:
            ConfigError: the precision cannot be had here.
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
        return cls(load_dinov2(backbone_file, device), network, infos, device, precision, input_px)

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth in metres for every raw (not undistorted) pixel of ``frame``.

        Gravity is estimated where the frame does not have it, or only guesses it. A wide view has the scale
        of its middle, see :mod:`slamdepth.depth.wide_view`.

        Raises:
            CameraError: the image is too small or too narrow for the network.
        """
        check_size(frame)
        whole = self._predict_view(frame)
        if (found := middle_view(frame)) is None:
            return whole
        middle, at = found
        if whole.gravity is not None:
            middle = replace(middle, gravity=whole.gravity, gravity_is_guess=False)
        return with_scale_of(whole, self._predict_view(middle), at)

    def _predict_view(self, frame: Frame) -> DepthPrediction:
        rotations = _Rotations(lambda roll: self._encode(frame, roll))
        if frame.gravity is not None and not frame.gravity_is_guess:
            return replace(self._upright(rotations, frame.gravity), gravity=frame.gravity, gravity_share=1.0)
        if (found := self._gravity(frame, rotations)) is None:
            return self._upright(rotations, frame.gravity)
        return replace(
            self._upright(rotations, found.gravity), gravity=found.gravity, gravity_share=found.share
        )

    def _encode(self, frame: Frame, roll: float) -> _Encoded:
        image, camera, view = frame.image_rgb, frame.camera, None
        if roll:
            view = UprightView(camera, roll)
            image = view.rotated(image)
        height, width = image.shape[:2]
        rows, columns = input_size(height, width, self._input_px)
        pixels = normalised(resize_rgb(image, rows, columns)[None], self.device)
        with torch.inference_mode():
            tapped = self._backbone(pixels.to(self._dtype), self._head.shape.taps)
            tokens = torch.stack([grid for grid, _ in tapped], dim=1).float()
            class_tokens = torch.stack([token for _, token in tapped], dim=1).float()
        focal_px = math.sqrt(camera.fx * camera.fy * rows * columns / (height * width))
        encoded = EncodedImage(tokens, (rows, columns), focal_px, roll)
        return _Encoded(encoded, class_tokens, pixels, (height, width), view)

    def _gravity(self, frame: Frame, rotations: _Rotations) -> GravityEstimate | None:
        if self._head.gravity is None:
            return None
        frames = manhattan_frames(find_lines(frame.image_rgb, frame.camera), FRAMES)
        guess = None if frame.gravity is None else roll_rad(frame.gravity)
        within = _SAME_ROLL_RAD if guess is None else _UPRIGHT_RAD
        return estimate_gravity(
            self._head.gravity, frames, lambda roll: rotations.upright_from(roll, within).image, guess
        )

    def _upright(self, rotations: _Rotations, gravity: Floats | None) -> DepthPrediction:
        """The prediction of the rotation in which the camera is upright; ``gravity (3,)`` is as taken."""
        if gravity is None:
            return self._predict(rotations.upright_from(0.0), None)
        encoded = rotations.upright_from(roll_rad(gravity), _UPRIGHT_RAD)
        return self._predict(encoded, encoded.image.rotated(gravity))

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
            trained_focal_px = image.focal_px * self._to_trained_px
            focal_px = torch.tensor([trained_focal_px], device=self.device)
            log_depth, sigma, scale_sigma = self._head(
                image.tokens, encoded.class_tokens, encoded.pixels, field, focal_px
            )
            both = torch.stack([log_depth, sigma], dim=1)
            full = F.interpolate(both, size=encoded.size, mode="bilinear", align_corners=False)[0]
            log_depth_full = full[0] + math.log(trained_focal_px / CANONICAL_FOCAL_PX)
            values = log_depth_full.exp().cpu().numpy()
            sigma_log = full[1].cpu().numpy()
        prediction = DepthPrediction(
            np.ascontiguousarray(values, dtype=np.float32),
            self.kind,
            np.ascontiguousarray(sigma_log, dtype=np.float32),
            scale_sigma_log=None if scale_sigma is None else float(scale_sigma[0]),
        )
        return prediction if encoded.view is None else encoded.view.rotated_back(prediction)


def _card(head: HeadEnsemble, weights: tuple[WeightsInfo, ...]) -> ModelCard:
    """The card of a head; its training images were brought to one focal length."""
    about = weights[-1] if weights else WeightsInfo("none", "", "unknown", "unknown")
    size = input_size(3, 4, head.shape.input_px)
    return ModelCard("dinov2", DepthKind.METRIC, size, CANONICAL_FOCAL_PX, about.licence, about.trained_on)


@register("dinov2")
def create(
    *,
    device: str = "cpu",
    seed: int = 0,
    weights: Path | None = None,
    precision: Precision = "auto",
    input_px: int | None = None,
) -> Dinov2Depth:
    """The model with the cached backbone and the head in ``weights``, by default the shipped one.

    Nothing in it is random: ``seed`` has no effect.
    """
    del seed
    return Dinov2Depth.load(head=weights, device=device, precision=precision, input_px=input_px)
