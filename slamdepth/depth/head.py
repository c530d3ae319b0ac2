# SPDX-License-Identifier: Apache-2.0
"""The depth head: DINOv2 tokens and the image in, log depth and its uncertainty out.

Tokens of several blocks (and class tokens, where scale is not told apart) are mixed at 1/14 of the
resolution, brought to 1/7 together with a strided view of the image, and upsampled to the full input
as convex combinations of the 3 x 3 coarse neighbours (Teed and Deng, RAFT, ECCV 2020):
the weights come from the image, so edges stay where the image has them.
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

from slamdepth.depth.gravity_direction import DownScorer
from slamdepth.depth.head_layers import (
    FACTOR,
    GRAVITY_CHANNELS,
    USUAL_DEPTH_M,
    Level,
    Residual,
    convex_upsample,
    zeroed,
)
from slamdepth.depth.layout import check_layout, pack_about, unpack_about
from slamdepth.depth.uncertainty import Doubt
from slamdepth.errors import WeightsError

UPSAMPLING = "weights."
"""Prefix of the parameters that only the upsampling to full resolution uses."""
FORMAT = "slamdepth-depth-head-5"
_EARLIER = tuple(f"slamdepth-depth-head-{number}" for number in range(1, 5))
"""The first format had no ``doubt``, the second no ``level_dim`` and no ``input_px``, the third no
``gravity`` and no ``down_dim``; up to the fourth the level read class tokens too, and a doubt not what the
head says itself, so that such parts can no longer be read."""


@dataclass(frozen=True)
class HeadShape:
    """What a head file needs to be built again.

    Attributes:
        taps: backbone blocks it reads, ascending.
        token_dim: width of the backbone.
        dim, blocks, guide_dim: channels and residual convolutions, see ``HeadConfig``.
        members: heads whose predictions are averaged.
        doubt: components of the tokens read by :class:`~slamdepth.depth.uncertainty.Doubt`, which then
            says with them how sure they are; 0 where the members alone do.
        level_dim: channels of the branch that tells a view's mean log depth apart from its relief;
            0 where one branch tells both.
        input_px: rows times columns of the images it learnt from, and is given.
        gravity: it is told where down is, by :func:`~slamdepth.depth.gravity_field.gravity_field`;
            needs ``level_dim``.
        down_dim: channels of the network that finds out which way is down; 0 where there is none.
    """

    taps: tuple[int, ...] = (5, 8, 11)
    token_dim: int = 384
    dim: int = 128
    blocks: int = 1
    guide_dim: int = 64
    members: int = 1
    doubt: int = 0
    level_dim: int = 0
    input_px: int = 238 * 322
    gravity: bool = False
    down_dim: int = 0


class DepthHead(nn.Module):
    """One head. ``dropout`` works in training only.

    With ``level_dim`` relief and level are told apart: relief, of mean 0, by tokens less their mean
    over the view, so that it cannot know a place by what is common to its tokens; the level by those
    means. With ``gravity`` both are told how far below the horizon they look.

    Raises:
        ValueError: ``gravity`` without ``level_dim``.
    """

    def __init__(self, shape: HeadShape, dropout: float = 0.0) -> None:
        super().__init__()
        if shape.gravity and not shape.level_dim:
            raise ValueError("a head that is told where down is needs a level_dim above 0")
        width = len(shape.taps) * shape.token_dim
        self.drop = nn.Dropout2d(dropout)
        self.tokens = nn.Conv2d(width, shape.dim, 1)
        self.level = Level(width, shape.level_dim, shape.gravity) if shape.level_dim else None
        self.class_tokens = None if shape.level_dim else nn.Linear(width, shape.dim)
        self.blocks = nn.ModuleList(Residual(shape.dim) for _ in range(shape.blocks))
        self.narrow = nn.Conv2d(shape.dim, shape.guide_dim, 1)
        self.guide = nn.Conv2d(3 * FACTOR * FACTOR, shape.guide_dim, 1)
        self.mix = Residual(shape.guide_dim)
        self.out = nn.Conv2d(shape.guide_dim, 2, 1)
        self.weights = nn.Conv2d(shape.guide_dim, 9 * FACTOR * FACTOR, 1)
        nn.init.normal_(self.out.weight, std=1e-3)
        self.out.bias = nn.Parameter(torch.tensor([math.log(USUAL_DEPTH_M), math.log(0.3)]))
        self.field = zeroed(nn.Conv2d(GRAVITY_CHANNELS, shape.dim, 1)) if shape.gravity else None

    def coarse(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Log depth and log spread ``(B, 2, H/7, W/7)``, and what the upsampling needs.

        Args:
            field: ``(B, 4, H/7, W/7)``, 0 where gravity is unknown; None where it is for all.
        """
        if field is None:
            rows, columns = image.shape[2] // FACTOR, image.shape[3] // FACTOR
            field = image.new_zeros(len(image), GRAVITY_CHANNELS, rows, columns)
        x = tokens.flatten(1, 2)
        level = None
        if self.level is not None:
            mean = x.mean(dim=(2, 3))
            level = self.level(mean, field.mean(dim=(2, 3)))
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
        if level is not None:
            log_depth = out[:, :1] - out[:, :1].mean(dim=(2, 3), keepdim=True) + level[:, None, None, None]
            out = torch.cat([log_depth, out[:, 1:]], dim=1)
        return out, features

    def forward(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> Tensor:
        """Predict from ``tokens (B, taps, dim, H/14, W/14)``, ``class_tokens (B, taps, dim)``,
        the ImageNet-normalised ``image (B, 3, H, W)`` and the gravity ``field (B, 4, H/7, W/7)``.

        Returns:
            ``(B, 2, H, W)``: natural logarithm of the canonical depth, and of its Laplace spread.
        """
        coarse, features = self.coarse(tokens, class_tokens, image, field)
        return convex_upsample(coarse, self.weights(features))


class HeadEnsemble(nn.Module):
    """Heads that learnt from different seeds or sources, averaged.

    Sigma is their geometric mean, averaged with what a :class:`~slamdepth.depth.uncertainty.Doubt`
    says where the shape has one. What they disagree on adds nothing: heads that know different things differ
    most in the scale of a whole image, which says nothing of its pixels, and the order of pixels
    by certainty got worse with it.

    Args:
        sigma_scale: factor that makes sigma cover 68 % of the errors on held-out places.
    """

    def __init__(self, shape: HeadShape, sigma_scale: float = 1.0) -> None:
        super().__init__()
        self.shape = shape
        self.sigma_scale = sigma_scale
        self.members = nn.ModuleList(DepthHead(shape) for _ in range(shape.members))
        self.doubt: Doubt | None = Doubt(shape.token_dim, shape.doubt) if shape.doubt else None
        width = len(shape.taps) * shape.token_dim
        self.down: DownScorer | None = DownScorer(width, shape.down_dim) if shape.down_dim else None

    def forward(
        self, tokens: Tensor, class_tokens: Tensor, image: Tensor, field: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Mean log depth and its calibrated standard deviation, each ``(B, H, W)``; see
        :meth:`DepthHead.forward`."""
        members = cast("list[DepthHead]", list(self.members))
        told = [member.coarse(tokens, class_tokens, image, field) for member in members]
        if self.doubt is not None:
            log_depth, own = torch.stack([coarse for coarse, _ in told]).mean(dim=0).unbind(dim=1)
            sine = torch.zeros_like(own) if field is None else field[:, 0]
            doubt = self.doubt(tokens[:, -1], log_depth, own, sine)
            told = [(torch.stack([coarse[:, 0], doubt], dim=1), features) for coarse, features in told]
        outs = torch.stack([
            convex_upsample(coarse, member.weights(features))
            for member, (coarse, features) in zip(members, told, strict=True)
        ])  # fmt: skip
        # A Laplace distribution of spread b has the variance 2 b^2.
        return outs[:, :, 0].mean(dim=0), self.sigma_scale * math.sqrt(2.0) * outs[:, :, 1].mean(dim=0).exp()


def save_head(path: Path, model: HeadEnsemble, about: dict[str, str]) -> None:
    """Write ``model`` in half precision, atomically, with ``about`` in the header."""
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
    """A head file, in eval mode, with its header.

    Raises:
        WeightsError: the file is missing, of another format, or a tensor is missing,
            extra or misshapen; names it.
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
    if (kind := meta.get("format")) not in (FORMAT, *_EARLIER):
        raise WeightsError(f"{path}: not a depth head of this package (format {kind!r})")
    try:
        values = json.loads(meta["shape"])
        shape = HeadShape(**{**values, "taps": tuple(values["taps"])})
        model = HeadEnsemble(shape, float(meta["sigma_scale"]))
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError(f"{path}: the header does not describe a depth head: {error}") from error
    if kind != FORMAT and (shape.level_dim or shape.doubt):
        raise WeightsError(
            f"{path}: a head of an earlier version of slamdepth ({kind}), which told scale or uncertainty in "
            f"another way; train it again with 'slamdepth train-depth'"
        )
    check_layout(
        {name: tuple(value.shape) for name, value in tensors.items()},
        {name: tuple(value.shape) for name, value in model.state_dict().items()},
        str(path),
    )
    model.load_state_dict({name: value.float() for name, value in tensors.items()})
    return model.eval().requires_grad_(False).to(device), meta
