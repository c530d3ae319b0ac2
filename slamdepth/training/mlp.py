# SPDX-License-Identifier: Apache-2.0
"""Training of the dissertation's network: three fully connected layers over all DINOv2 tokens.

Loss MSE * exp(1 - SSIM) or MSE alone, Adam at 1e-4, no augmentation, images resized to 224 x 224 without
keeping their aspect. Depth is normalised to one focal length, so that places seen by different cameras agree.
The same training without the ViT, on the pixels themselves, is the dissertation's ablation.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2_mlp import SIDE, MlpHead, token_features
from slamdepth.depth.preprocess import focal_px_at, normalised, resize_rgb
from slamdepth.errors import ConfigError
from slamdepth.evaluation.depth_maps import SSIM_SIGMA, SSIM_WINDOW, ssim_map
from slamdepth.training.data import Place, fingerprint
from slamdepth.training.progress import Progress, TrainStep, silent

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.depth.dinov2 import DinoV2

logger = logging.getLogger(__name__)

_ENCODED_AT_ONCE = 8


@dataclass(frozen=True)
class MlpSettings:
    """Settings of one training. The defaults are the dissertation's except for its 500 epochs.

    Attributes:
        output: side of the depth map, 32 or 224.
        ssim: the loss is MSE * exp(1 - SSIM); False: MSE.
        hidden: width of the two inner layers.
        bfloat16: matrix products round their factors to bfloat16: twice as fast on processors that have it.
        min_m, max_m: range of the sensor depths trained on.
    """

    output: int = 32
    ssim: bool = True
    epochs: int = 20
    batch: int = 32
    learning_rate: float = 1e-4
    hidden: int = 1024
    seed: int = 0
    bfloat16: bool = False
    min_m: float = 0.2
    max_m: float = 10.0


@dataclass(frozen=True)
class MlpPairs:
    """Images and depth of one or more places, resized to 224 x 224.

    Attributes:
        image_rgb: ``(N, 224, 224, 3)`` uint8.
        depth_m: ``(N, 224, 224)`` float32 metres for the camera of the place, 0 unknown.
        focal_px: ``(N,)`` focal length of each resized image, geometric mean of both axes.
    """

    image_rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    focal_px: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.image_rgb)

    def depth_at(self, focal_px: float) -> NDArray[np.float32]:
        """``depth_m`` normalised to a focal length of ``focal_px`` pixels."""
        factor = (focal_px / self.focal_px).astype(np.float32)
        return self.depth_m * factor[:, None, None]


def read_pairs(places: Sequence[Place]) -> MlpPairs:
    """All pairs of ``places``; depth is resized by nearest neighbour.

    Raises:
        DatasetError: a file does not decode.
    """
    import cv2

    images, depths, focals = [], [], []
    for place in places:
        for index in range(len(place)):
            frame = place.read(index)
            assert frame.depth_m is not None
            images.append(resize_rgb(frame.image_rgb, SIDE, SIDE))
            depths.append(cv2.resize(frame.depth_m, (SIDE, SIDE), interpolation=cv2.INTER_NEAREST))
            focals.append(focal_px_at(frame.camera, SIDE, SIDE))
    return MlpPairs(np.stack(images), np.stack(depths).astype(np.float32), np.array(focals))


def cached_tokens(
    place: Place,
    backbone: DinoV2,
    backbone_sha256: str,
    *,
    device: str = "cpu",
    progress: Progress = silent,
) -> NDArray[np.float16]:
    """Class and patch tokens ``(N, 257 * dim)`` of every image of ``place``, from the cache if there."""
    key = fingerprint((), backbone_sha256, place.fingerprint)
    file = store.cache_dir() / "features" / f"mlp-{place.name}-{key}.npy"
    if not file.is_file():
        images = read_pairs([place]).image_rgb
        parts = []
        for start in range(0, len(images), _ENCODED_AT_ONCE):
            with torch.inference_mode():
                batch = normalised(images[start : start + _ENCODED_AT_ONCE], device)
                parts.append(token_features(backbone, batch).half().cpu().numpy())
            done = min(start + _ENCODED_AT_ONCE, len(images))
            progress(TrainStep(f"tokens of {place.name}", done, len(images)))
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_name(f"{file.stem}.partial.npy")
        np.save(partial, np.concatenate(parts))
        partial.replace(file)
    tokens: NDArray[np.float16] = np.load(file, mmap_mode="r")
    return tokens


def train_mlp(
    features: NDArray[np.generic],
    depth_m: NDArray[np.float32],
    settings: MlpSettings,
    *,
    device: str = "cpu",
    progress: Progress = silent,
) -> tuple[MlpHead, list[float]]:
    """Train one head. The result is the same for the same seed on the same machine.

    Args:
        features: ``(N, F)``, the input of each image.
        depth_m: ``(N, 224, 224)`` metres at one focal length, 0 where unknown.

    Returns:
        The head in eval mode, and the mean loss of each epoch.

    Raises:
        ConfigError: the loss has become infinite or NaN; the learning rate is too large.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        head = MlpHead(settings.output, features.shape[1], settings.hidden)
    head.fit_scaler(torch.from_numpy(np.array(features)))
    head.to(device).train()
    in_range = np.where((depth_m >= settings.min_m) & (depth_m <= settings.max_m), depth_m, 0.0)
    target = shrink(torch.from_numpy(in_range.astype(np.float32)), settings.output)
    # The fused step is several times faster on a CPU, where Adam costs as much as the network.
    optimiser = torch.optim.Adam(head.parameters(), lr=settings.learning_rate, fused=True)
    loss_of = mse_ssim_loss if settings.ssim else mse_loss
    rng = np.random.default_rng(settings.seed)
    losses: list[float] = []
    for epoch in range(settings.epochs):
        order = rng.permutation(len(features))
        starts = range(0, len(order), settings.batch)
        total = 0.0
        for start in starts:
            chosen = np.sort(order[start : start + settings.batch])
            x = torch.from_numpy(np.asarray(features[chosen], dtype=np.float32)).to(device)
            optimiser.zero_grad(set_to_none=True)
            with _rounded_products(settings.bfloat16):
                loss = loss_of(head(x), target[chosen].to(device))
                torch.autograd.backward(loss)
            optimiser.step()
            total += float(loss.detach())
        losses.append(total / len(starts))
        if not math.isfinite(losses[-1]):
            raise ConfigError(f"the loss of epoch {epoch + 1} is {losses[-1]}: use a smaller learning rate")
        logger.info("epoch %d: loss %.4f", epoch + 1, losses[-1])
        progress(TrainStep("training", epoch + 1, settings.epochs, f"loss {losses[-1]:.4f}"))
    return head.eval().requires_grad_(False), losses


@contextmanager
def _rounded_products(bfloat16: bool) -> Iterator[None]:
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium" if bfloat16 else before)
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


def mse_loss(predicted_m: Tensor, target_m: Tensor) -> Tensor:
    """MSE over each image's known pixels, then the mean over images; arguments of :func:`mse_ssim_loss`."""
    weight = (target_m > 0).to(predicted_m.dtype)
    loss: Tensor = _squared_error(predicted_m, target_m, weight).mean()
    return loss


def mse_ssim_loss(predicted_m: Tensor, target_m: Tensor) -> Tensor:
    """MSE * exp(1 - SSIM) over each image's known pixels, then the mean over images.

    Args:
        predicted_m, target_m: ``(B, S, S)`` metres; a target of 0 is unknown. The data range of
            SSIM is the target's largest depth, as in
            :func:`slamdepth.evaluation.depth_maps.depth_ssim`.
    """
    weight = (target_m > 0).to(predicted_m.dtype)
    mse = _squared_error(predicted_m, target_m, weight)
    data_range = target_m.amax(dim=(1, 2), keepdim=True).clamp_min(1e-3)
    similar = ssim_map(predicted_m, target_m, weight, _blur, data_range)
    ssim = (similar * weight).sum(dim=(1, 2)) / _known(weight)
    loss: Tensor = (mse * (1.0 - ssim).exp()).mean()
    return loss


def _squared_error(predicted_m: Tensor, target_m: Tensor, weight: Tensor) -> Tensor:
    squared: Tensor = (predicted_m - target_m).square() * weight
    return squared.sum(dim=(1, 2)) / _known(weight)


def _known(weight: Tensor) -> Tensor:
    return weight.sum(dim=(1, 2)).clamp_min(1.0)


def shrink(depth_m: Tensor, side: int) -> Tensor:
    """``depth_m (N, 224, 224)`` as ``(N, side, side)``: the mean of each block's known pixels, else 0."""
    if depth_m.shape[-1] == side:
        return depth_m
    step = depth_m.shape[-1] // side
    known = F.avg_pool2d((depth_m > 0).float()[:, None], step)[:, 0]
    mean = F.avg_pool2d(depth_m[:, None], step)[:, 0]
    return torch.where(known > 0, mean / known.clamp_min(1e-6), 0.0)


def _blur(maps: Tensor) -> Tensor:
    # A banded matrix from both sides: on a CPU five times faster than convolutions of one channel.
    at = torch.arange(maps.shape[-1], dtype=maps.dtype, device=maps.device)
    offsets = at[:, None] - at
    window = torch.arange(SSIM_WINDOW, dtype=maps.dtype, device=maps.device) - SSIM_WINDOW // 2
    total = torch.exp(-window.square() / (2 * SSIM_SIGMA**2)).sum()
    band = torch.exp(-offsets.square() / (2 * SSIM_SIGMA**2)) / total
    band = torch.where(offsets.abs() <= SSIM_WINDOW // 2, band, 0.0)
    return band @ maps @ band
