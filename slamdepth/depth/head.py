# SPDX-License-Identifier: Apache-2.0
"""The depth head: DINOv2 tokens and the image in, log depth and its uncertainty out.

Tokens of several blocks (and class tokens, where there is no scale branch) are mixed at 1/14 of the
resolution, brought to 1/7 together with a strided view of the image, and upsampled to the full input by
convex combinations of the 3 x 3 coarse neighbours (Teed and Deng, RAFT, ECCV 2020). The weights come from
the image, so edges stay where the image has them.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.adapters import Adapters
from slamdepth.depth.gravity_direction import GravityScorer
from slamdepth.depth.head_layers import (
    FACTOR,
    GRAVITY_CHANNELS,
    INITIAL_DEPTH_M,
    Residual,
    ScaleBranch,
    convex_upsample,
    zeroed,
)
from slamdepth.depth.layout import check_layout, pack_about, unpack_about
from slamdepth.depth.scale_uncertainty import ScaleUncertainty, scale_tap
from slamdepth.depth.uncertainty import UncertaintyNet
from slamdepth.errors import WeightsError

UPSAMPLING = "weights."
"""Prefix of the parameters that only the upsampling to full resolution uses."""
_FORMAT_NAME = "slamdepth-depth-head-"
FORMAT = f"{_FORMAT_NAME}8"
_ALSO_READ = (f"{_FORMAT_NAME}6", f"{_FORMAT_NAME}7")
"""Formats before: without an uncertainty of the scale, and without adapters of the backbone."""


@dataclass(frozen=True)
class HeadShape:
    """The shape of a head's network, as kept in the header of its file.

    Attributes:
        taps: backbone blocks that are read, ascending.
        token_dim: width of the backbone.
        dim: channels at token resolution.
        blocks: residual convolutions at token resolution.
        guide_dim: channels that carry image edges to the upsampling.
        members: heads whose predictions are averaged.
        uncertainty_dim: principal components of the tokens that an
            :class:`~slamdepth.depth.uncertainty.UncertaintyNet` reads; 0 where there is none and each member
            predicts its uncertainty alone.
        scale_dim: channels of the branch that predicts a view's mean log depth (its scale), while the rest of
            the head predicts its shape; 0 where one branch predicts both.
        input_px: rows times columns of the images it was trained on, and is given.
        gravity: a gravity field is read (:func:`~slamdepth.depth.gravity_field.gravity_field`); needs
            ``scale_dim``.
        gravity_dim: channels of the network that estimates the direction of gravity; 0 where there is none.
        subspace_dim: dimensions of the subspace of tokens of a
            :class:`~slamdepth.depth.scale_uncertainty.ScaleUncertainty`; 0 where there is none.
        adapted_blocks: last blocks of the backbone that :class:`~slamdepth.depth.adapters.Adapters` change.
        adapter_rank: rank of these changes; 0 where the backbone is read as it is.
    """

    taps: tuple[int, ...] = (5, 8, 11)
    token_dim: int = 384
    dim: int = 128
    blocks: int = 1
    guide_dim: int = 64
    members: int = 1
    uncertainty_dim: int = 0
    scale_dim: int = 0
    input_px: int = 238 * 322
    gravity: bool = False
    gravity_dim: int = 0
    subspace_dim: int = 0
    adapted_blocks: int = 0
    adapter_rank: int = 0


class DepthHead(nn.Module):
    """One head: log depth and its Laplace spread from tokens and image.

    With ``shape.scale_dim`` the head has a shape branch and a scale branch. The shape branch predicts log
    depth of mean 0 from the tokens less their mean over the view, so that it cannot recognise a place by what
    its tokens have in common; the scale branch predicts the mean log depth from those means. With
    ``shape.gravity`` both branches also read how far below the horizon each part of the view lies.

    Args:
        shape: of the network.
        dropout: share of token channels dropped; works in training only.

    Raises:
        ValueError: ``shape.gravity`` without ``shape.scale_dim``.
    """

    def __init__(self, shape: HeadShape, dropout: float = 0.0) -> None:
        super().__init__()
        if shape.gravity and not shape.scale_dim:
            raise ValueError("a head that reads gravity needs a scale_dim above 0")
        width = len(shape.taps) * shape.token_dim
        self.drop = nn.Dropout2d(dropout)
        self.tokens = nn.Conv2d(width, shape.dim, 1)
        self.scale_branch = ScaleBranch(width, shape.scale_dim, shape.gravity) if shape.scale_dim else None
        self.class_tokens = None if shape.scale_dim else nn.Linear(width, shape.dim)
        self.blocks = nn.ModuleList(Residual(shape.dim) for _ in range(shape.blocks))
        self.narrow = nn.Conv2d(shape.dim, shape.guide_dim, 1)
        self.guide = nn.Conv2d(3 * FACTOR * FACTOR, shape.guide_dim, 1)
        self.mix = Residual(shape.guide_dim)
        self.out = nn.Conv2d(shape.guide_dim, 2, 1)
        self.weights = nn.Conv2d(shape.guide_dim, 9 * FACTOR * FACTOR, 1)
        nn.init.normal_(self.out.weight, std=1e-3)
        self.out.bias = nn.Parameter(torch.tensor([math.log(INITIAL_DEPTH_M), math.log(0.3)]))
        self.field = zeroed(nn.Conv2d(GRAVITY_CHANNELS, shape.dim, 1)) if shape.gravity else None

    def coarse(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The prediction before the upsampling.

        Args:
            tokens: ``(B, taps, dim, H/14, W/14)``.
            class_tokens: ``(B, taps, dim)``.
            image: ``(B, 3, H, W)``, ImageNet-normalised.
            field: gravity field ``(B, 4, H/7, W/7)``, 0 where gravity is unknown; None: unknown for all.

        Returns:
            Log depth and log spread ``(B, 2, H/7, W/7)``, and the features that give the weights of the
            upsampling, ``(B, guide_dim, H/7, W/7)``.
        """
        if field is None:
            rows, columns = image.shape[2] // FACTOR, image.shape[3] // FACTOR
            field = image.new_zeros(len(image), GRAVITY_CHANNELS, rows, columns)
        x = tokens.flatten(1, 2)
        scale = None
        if self.scale_branch is not None:
            mean = x.mean(dim=(2, 3))
            scale = self.scale_branch(mean, field.mean(dim=(2, 3)))
            x = x - mean[..., None, None]
        x = self.tokens(self.drop(x))
        if self.class_tokens is not None:
            cls = self.drop(class_tokens.flatten(1)[..., None, None])[..., 0, 0]
            x = x + self.class_tokens(cls)[..., None, None]
        if self.field is not None:
            x = x + self.field(F.avg_pool2d(field, 2))
        x = F.gelu(x)
        for block in self.blocks:
            x = block(x)
        x = F.interpolate(self.narrow(x), scale_factor=2, mode="bilinear", align_corners=False)
        features = self.mix(F.gelu(x + self.guide(F.pixel_unshuffle(image, FACTOR))))
        out: Tensor = self.out(features)
        if scale is not None:
            log_depth = out[:, :1] - out[:, :1].mean(dim=(2, 3), keepdim=True) + scale[:, None, None, None]
            out = torch.cat([log_depth, out[:, 1:]], dim=1)
        return out, features

    def forward(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> Tensor:
        """The prediction at full resolution.

        Args:
            tokens: ``(B, taps, dim, H/14, W/14)``.
            class_tokens: ``(B, taps, dim)``.
            image: ``(B, 3, H, W)``, ImageNet-normalised.
            field: gravity field ``(B, 4, H/7, W/7)``, 0 where gravity is unknown; None: unknown for all.

        Returns:
            ``(B, 2, H, W)``: natural logarithm of the canonical depth, and of its Laplace spread.
        """
        coarse, features = self.coarse(tokens, class_tokens, image, field)
        return convex_upsample(coarse, self.weights(features))


class HeadEnsemble(nn.Module):
    """Heads trained with different seeds or on different sources, averaged.

    Sigma is the geometric mean of the members', averaged with the estimate of an
    :class:`~slamdepth.depth.uncertainty.UncertaintyNet` where the shape has one. Disagreement between members
    does not add to it: heads trained on different sources differ most in the scale of a whole image, which
    says nothing of its pixels, and sigma ordered the pixels of an image worse with it.

    Args:
        shape: of the network.
        sigma_scale: factor that makes sigma cover 68 % of the errors on held-out places.
    """

    def __init__(self, shape: HeadShape, sigma_scale: float = 1.0) -> None:
        super().__init__()
        self.shape = shape
        self.sigma_scale = sigma_scale
        self.members = nn.ModuleList(DepthHead(shape) for _ in range(shape.members))
        self.uncertainty: UncertaintyNet | None = (
            UncertaintyNet(shape.token_dim, shape.uncertainty_dim) if shape.uncertainty_dim else None
        )
        self.scale: ScaleUncertainty | None = (
            ScaleUncertainty(shape.token_dim, shape.subspace_dim) if shape.subspace_dim else None
        )
        width = len(shape.taps) * shape.token_dim
        self.gravity: GravityScorer | None = (
            GravityScorer(width, shape.gravity_dim) if shape.gravity_dim else None
        )
        self.adapters: Adapters | None = (
            Adapters(shape.token_dim, shape.adapted_blocks, shape.adapter_rank)
            if shape.adapter_rank
            else None
        )

    def forward(
        self,
        tokens: Tensor,
        class_tokens: Tensor,
        image: Tensor,
        field: Tensor | None = None,
        focal_px: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor | None]:
        """The mean prediction at full resolution.

        Args:
            tokens: ``(B, taps, dim, H/14, W/14)``.
            class_tokens: ``(B, taps, dim)``.
            image: ``(B, 3, H, W)``, ImageNet-normalised.
            field: gravity field ``(B, 4, H/7, W/7)``, 0 where gravity is unknown; None: unknown for all.
            focal_px: ``(B,)`` focal length in pixels of ``image``; None: one that was trained.

        Returns:
            Natural logarithm of the canonical depth and its calibrated standard deviation, both
            ``(B, H, W)``; and that of the scale error that an image has in common, ``(B,)``, infinite where
            the image is unlike the training; None where no uncertainty was fitted to left-out places.
        """
        members = cast("list[DepthHead]", list(self.members))
        predicted = [member.coarse(tokens, class_tokens, image, field) for member in members]
        mean_log_depth, own = torch.stack([coarse for coarse, _ in predicted]).mean(dim=0).unbind(dim=1)
        scale_sigma = None
        if self.scale is not None:
            log_focal = self.scale.focal.mean().expand(len(own)) if focal_px is None else focal_px.log()
            distance = self.scale.distance(tokens[:, scale_tap(tokens.shape[1])])
            scale_sigma = self.scale(distance, own.mean(dim=(1, 2)), log_focal)
        if self.uncertainty is not None:
            sine = torch.zeros_like(own) if field is None else field[:, 0]
            log_spread = self.uncertainty(tokens[:, -1], mean_log_depth, own, sine)
            predicted = [
                (torch.stack([coarse[:, 0], log_spread], dim=1), features) for coarse, features in predicted
            ]
        outs = torch.stack([
            convex_upsample(coarse, member.weights(features))
            for member, (coarse, features) in zip(members, predicted, strict=True)
        ])  # fmt: skip
        # A Laplace distribution of spread b has the variance 2 b^2.
        sigma = self.sigma_scale * math.sqrt(2.0) * outs[:, :, 1].mean(dim=0).exp()
        return outs[:, :, 0].mean(dim=0), sigma, scale_sigma


def save_head(path: Path, model: HeadEnsemble, about: dict[str, str]) -> None:
    """Write ``model`` in half precision, atomically.

    Args:
        path: a safetensors file; missing folders are made.
        model: the heads.
        about: kept in the header next to the format and the shape, such as ``trained_on`` and ``licence``.

    Raises:
        OSError: the file cannot be written.
    """
    from safetensors.torch import save

    tensors = {name: value.detach().half().contiguous() for name, value in model.state_dict().items()}
    meta = {
        **about,
        "format": FORMAT,
        "shape": json.dumps(asdict(model.shape)),
        "sigma_scale": repr(float(model.sigma_scale)),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(path.name + ".partial")
    partial.write_bytes(save(tensors, metadata=pack_about(meta)))
    partial.replace(path)


def load_head(path: Path, device: str = "cpu") -> tuple[HeadEnsemble, dict[str, str]]:
    """Read a head file.

    Returns:
        The heads, frozen and in eval mode, and the header.

    Raises:
        WeightsError: the file is missing, of another or an earlier format, or a tensor is missing, extra or
            misshapen; names it.
    """
    from safetensors import SafetensorError, safe_open

    if not path.is_file():
        raise WeightsError(f"{path}: no such depth head")
    try:
        with safe_open(str(path), framework="pt") as file:
            meta = unpack_about(file.metadata())
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file: {error}") from error
    if (kind := meta.get("format", "")) not in (FORMAT, *_ALSO_READ):
        if kind.startswith(_FORMAT_NAME):
            raise WeightsError(
                f"{path}: a head of another version of slamdepth ({kind}, not {FORMAT}); train it again with "
                "'slamdepth train-depth'"
            )
        raise WeightsError(f"{path}: not a depth head of this package (format {meta.get('format')!r})")
    try:
        values = json.loads(meta["shape"])
        shape = HeadShape(**{**values, "taps": tuple(values["taps"])})
        model = HeadEnsemble(shape, float(meta["sigma_scale"]))
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: the header does not describe a depth head: {error}") from error
    check_layout(
        {name: tuple(value.shape) for name, value in tensors.items()},
        {name: tuple(value.shape) for name, value in model.state_dict().items()},
        str(path),
    )
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    return model.eval().requires_grad_(False).to(device), meta
