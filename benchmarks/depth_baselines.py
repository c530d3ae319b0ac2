# SPDX-License-Identifier: Apache-2.0
"""What a depth network has to beat: a constant, the mean depth image, and the dissertation's MLP.

The MLP is trained on DINOv2's tokens, as in the dissertation, and on the pixels alone, without a ViT; on the
tokens also without SSIM in the loss.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from slamdepth.depth import weights as store
from slamdepth.depth.base import DepthModel
from slamdepth.depth.card import ModelCard
from slamdepth.depth.dinov2 import load_dinov2
from slamdepth.depth.dinov2_mlp import SIDE, Dinov2Mlp, MlpHead, at_size, load_mlp, read_header, save_mlp
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import focal_px_at, resize_rgb
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of
from slamdepth.training.mlp import MlpPairs, MlpSettings, cached_tokens, read_pairs, train_mlp
from slamdepth.training.progress import Progress, silent
from slamdepth.training.readers.pairs import PairPlace
from slamdepth.types import DepthKind, DepthPrediction, Frame, WeightsInfo
from slamdepth.typing import Floats32

MLPS = {
    "dinov2-mlp-32": ("tokens", 32, True),
    "dinov2-mlp-32-mse": ("tokens", 32, False),
    "dinov2-mlp-224": ("tokens", 224, True),
    "dinov2-mlp-224-mse": ("tokens", 224, False),
    "pixel-mlp-32": ("pixels", 32, True),
    "pixel-mlp-224": ("pixels", 224, True),
}
"""Trained baselines: what they see, the side of their depth map in pixels, whether SSIM is in the loss."""

BASELINES = ("constant", "mean-image", *MLPS)
_PIXELS = 3 * SIDE * SIDE


class ConstantDepth:
    """The same depth in metres everywhere."""

    name, kind = "constant", DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, depth_m: float) -> None:
        self.depth_m = depth_m

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth ``(H, W)`` in metres."""
        return DepthPrediction(np.full(frame.image_rgb.shape[:2], self.depth_m, np.float32), self.kind)


class MeanImageDepth:
    """The mean of the training depth at each place of the image.

    Args:
        depth_m: ``(S, S)`` metres, seen by a camera of ``focal_px`` at that size.
    """

    name, kind = "mean-image", DepthKind.METRIC
    weights: tuple[WeightsInfo, ...] = ()

    def __init__(self, depth_m: Floats32, focal_px: float) -> None:
        self.depth_m, self.focal_px = depth_m, focal_px

    def predict(self, frame: Frame) -> DepthPrediction:
        """Depth ``(H, W)`` in metres, scaled to the focal length of the frame."""
        rows, columns = self.depth_m.shape
        factor = focal_px_at(frame.camera, rows, columns) / self.focal_px
        height, width = frame.image_rgb.shape[:2]
        full = at_size(torch.from_numpy(self.depth_m)[None], height, width)
        return DepthPrediction(full * np.float32(factor), self.kind)


class PixelMlp(NetworkDepth):
    """The dissertation's fully connected head on the 224 x 224 image itself, without a ViT."""

    def __init__(self, head: MlpHead, focal_px: float, weights: tuple[WeightsInfo, ...] = ()) -> None:
        card = ModelCard("pixel-mlp", DepthKind.METRIC, (SIDE, SIDE), focal_px, "unknown", "unknown")
        super().__init__(card, weights)
        self._head = head

    @classmethod
    def load(cls, file: Path) -> PixelMlp:
        """Read a head that ``save_mlp`` wrote.

        Raises:
            WeightsError: the file is no such head.
        """
        head, about = load_mlp(file, features=_PIXELS)
        info = WeightsInfo(file.stem, sha256_of(file), about["trained_on"], about["licence"])
        return cls(head, float(about["focal_px"]), (info,))

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[Floats32, tuple[int, int]]:
        """Depth ``(H, W)`` in metres for the card's focal length, and the size of the network's input."""
        height, width = image_rgb.shape[:2]
        pixels = torch.from_numpy(resize_rgb(image_rgb, SIDE, SIDE).reshape(1, -1)).float()
        with torch.inference_mode():
            depth_m = self._head(pixels)
        return at_size(depth_m, height, width), (SIDE, SIDE)


@dataclass(frozen=True)
class Recipe:
    """A model to judge.

    Attributes:
        make: makes the model, on the first call only.
        settings: what decides its figures; they are computed again when it changes.
    """

    make: Callable[[], DepthModel]
    settings: dict[str, Any]


class Baselines:
    """Fits the baselines to training pairs, each when it is first judged.

    Args:
        places: training pairs.
        settings: of the trainings, by the side of the depth map; one setting for both where it is no mapping.
        folder: where trained heads are kept; one with the same settings is not trained again.
        progress: called with the name of a training; returns the function that its steps are passed to.
    """

    def __init__(
        self,
        places: list[PairPlace],
        settings: MlpSettings | Mapping[int, MlpSettings],
        folder: Path,
        progress: Callable[[str], Progress] = lambda name: silent,
    ) -> None:
        self.places, self.folder = places, folder
        self._settings = settings if isinstance(settings, Mapping) else {32: settings, 224: settings}
        self._progress = progress

    def recipe(self, name: str) -> Recipe:
        """The recipe of one of :data:`BASELINES`."""
        seen = {"places": self._seen}
        if name == "constant":
            return Recipe(functools.cache(self._constant), seen)
        if name == "mean-image":
            return Recipe(functools.cache(self._mean_image), seen)
        return Recipe(
            functools.cache(lambda: self._trained(name)), {**asdict(self.settings_of(name)), **seen}
        )

    def settings_of(self, name: str) -> MlpSettings:
        """The settings of the training of one of :data:`MLPS`."""
        _, output, ssim = MLPS[name]
        return replace(self._settings[output], output=output, ssim=ssim)

    def losses(self) -> dict[str, list[float]]:
        """Mean loss of each epoch of the trained heads in the folder, by name."""
        done = [name for name in MLPS if _was_trained(self._file(name), self._described(name))]
        return {name: json.loads(read_header(self._file(name))["losses"]) for name in done}

    def _file(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"

    def _described(self, name: str) -> str:
        return json.dumps({**asdict(self.settings_of(name)), "places": self._seen})

    @property
    def _seen(self) -> list[str]:
        return [f"{place.name} {len(place)} {place.fingerprint}" for place in self.places]

    @functools.cached_property
    def _pairs(self) -> MlpPairs:
        return read_pairs(self.places)

    @functools.cached_property
    def _focal_px(self) -> float:
        """The median focal length of the training images; all depth is scaled to it."""
        return float(np.median(self._pairs.focal_px))

    @functools.cached_property
    def _tokens(self) -> NDArray[np.float16]:
        file = store.find_backbone(None)
        sha256, backbone = store.verify(file), load_dinov2(file)
        parts = [
            cached_tokens(place, backbone, sha256, progress=self._progress(f"tokens of {place.name}"))
            for place in self.places
        ]
        return np.concatenate(parts)

    def _constant(self) -> DepthModel:
        return ConstantDepth(float(np.median(self._pairs.depth_m[self._pairs.depth_m > 0])))

    def _mean_image(self) -> DepthModel:
        depth_m = self._pairs.depth_at(self._focal_px)
        count = (depth_m > 0).sum(axis=0)
        mean = depth_m.sum(axis=0) / np.maximum(count, 1)
        filled = np.where(count > 0, mean, mean[count > 0].mean())
        return MeanImageDepth(filled.astype(np.float32), self._focal_px)

    def _trained(self, name: str) -> DepthModel:
        source, settings = MLPS[name][0], self.settings_of(name)
        described, file = self._described(name), self._file(name)
        if not _was_trained(file, described):
            pixels = self._pairs.image_rgb.reshape(len(self._pairs), -1)
            features = self._tokens if source == "tokens" else pixels
            depth_m = self._pairs.depth_at(self._focal_px)
            head, losses = train_mlp(features, depth_m, settings, progress=self._progress(name))
            about = {
                "trained_on": ", ".join(place.name for place in self.places),
                "licence": "trained on data for research use",
                "focal_px": repr(self._focal_px),
                "settings": described,
                "losses": json.dumps(losses),
            }
            save_mlp(file, head, about)
        return Dinov2Mlp.load(weights=file) if source == "tokens" else PixelMlp.load(file)


def _was_trained(file: Path, described: str) -> bool:
    if not file.is_file():
        return False
    try:
        return read_header(file).get("settings") == described
    except WeightsError:
        return False
