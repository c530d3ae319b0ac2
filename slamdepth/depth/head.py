# SPDX-License-Identifier: Apache-2.0
"""The depth head: DINOv2 tokens and the image in, log depth and its uncertainty out.

Tokens of several blocks and their class tokens are mixed at 1/14 of the resolution,
brought to 1/7 together with a strided view of the image, and upsampled to the full input
as convex combinations of the 3 x 3 coarse neighbours (Teed and Deng, RAFT, ECCV 2020):
the weights come from the image, so edges stay where the image has them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from slamdepth.depth.doubt import Doubt
from slamdepth.depth.head_layers import FACTOR, USUAL_DEPTH_M, Level, Residual, convex_upsample
from slamdepth.depth.layout import check_layout, pack_about, unpack_about
from slamdepth.errors import WeightsError

UPSAMPLING = "weights."
"""Prefix of the parameters that only the upsampling to full resolution uses."""
FORMAT = "slamdepth-depth-head-3"
_READABLE = ("slamdepth-depth-head-1", "slamdepth-depth-head-2", FORMAT)
"""The first format had no ``doubt``, the second no ``level_dim`` and no ``input_px``."""


@dataclass(frozen=True)
class HeadShape:
    """What a head file needs to be built again.

    Attributes:
        taps: backbone blocks it reads, ascending.
        token_dim: width of the backbone.
        dim, blocks, guide_dim: channels and residual convolutions, see ``HeadConfig``.
        members: heads whose predictions are averaged.
        doubt: components of the tokens read by :class:`~slamdepth.depth.doubt.Doubt`, which then
            says how sure they are; 0 where the members themselves do.
        level_dim: channels of the branch that tells a view's mean log depth apart from its relief;
            0 where one branch tells both.
        input_px: rows times columns of the images it learnt from, and is given.
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


@dataclass(frozen=True)
class HeadFeatures:
    """All that is left to decode.

    Attributes:
        seen: ``(members, B, guide_dim, H/7, W/7)`` what each member's last layers read.
        doubt: ``(B, H/7, W/7)`` log spread common to the members; None where each has its own.
        level: ``(members, B)`` mean log depth of a view; None where the last layers tell it.
    """

    seen: Tensor
    doubt: Tensor | None = None
    level: Tensor | None = None


@dataclass(frozen=True)
class LastLayerChange:
    """How log depth differs from what was trained.

    Attributes:
        weights: ``(members, guide_dim)`` added to those of the last layer; what that does to an
            image's mean log depth is taken out again.
        offset: added to log depth everywhere.
    """

    weights: Tensor
    offset: float = 0.0


class DepthHead(nn.Module):
    """One head. ``dropout`` works in training only.

    With ``level_dim`` relief and level are told apart: relief, of mean 0, by tokens less their mean
    over the view, so that it cannot know a place by what is common to its tokens; the level by those
    means and the class tokens.
    """

    def __init__(self, shape: HeadShape, dropout: float = 0.0) -> None:
        super().__init__()
        width = len(shape.taps) * shape.token_dim
        self.drop = nn.Dropout2d(dropout)
        self.tokens = nn.Conv2d(width, shape.dim, 1)
        self.level = Level(width, shape.level_dim) if shape.level_dim else None
        self.class_tokens = None if shape.level_dim else nn.Linear(width, shape.dim)
        self.blocks = nn.ModuleList(Residual(shape.dim) for _ in range(shape.blocks))
        self.narrow = nn.Conv2d(shape.dim, shape.guide_dim, 1)
        self.guide = nn.Conv2d(3 * FACTOR * FACTOR, shape.guide_dim, 1)
        self.mix = Residual(shape.guide_dim)
        self.out = nn.Conv2d(shape.guide_dim, 2, 1)
        self.weights = nn.Conv2d(shape.guide_dim, 9 * FACTOR * FACTOR, 1)
        nn.init.normal_(self.out.weight, std=1e-3)
        self.out.bias = nn.Parameter(torch.tensor([math.log(USUAL_DEPTH_M), math.log(0.3)]))

    def see(self, tokens: Tensor, class_tokens: Tensor, image: Tensor) -> tuple[Tensor, Tensor | None]:
        """What the last layers read ``(B, guide_dim, H/7, W/7)``, and the level ``(B,)`` if told apart."""
        x, cls = tokens.flatten(1, 2), class_tokens.flatten(1)
        level = None
        if self.level is not None:
            mean = x.mean(dim=(2, 3))
            level = self.level(cls, mean)
            x = x - mean[..., None, None]
        x = self.tokens(self.drop(x))
        if self.class_tokens is not None:
            x = x + self.class_tokens(self.drop(cls[..., None, None])[..., 0, 0])[..., None, None]
        x = F.gelu(x)
        for block in self.blocks:
            x = block(x)
        x = F.interpolate(self.narrow(x), scale_factor=2, mode="bilinear", align_corners=False)
        return self.mix(F.gelu(x + self.guide(F.pixel_unshuffle(image, FACTOR)))), level

    def tell(self, seen: Tensor, level: Tensor | None) -> Tensor:
        """Log depth and log spread ``(B, 2, H/7, W/7)`` from what :meth:`see` gives."""
        out: Tensor = self.out(seen)
        if level is None:
            return out
        log_depth = out[:, :1] - out[:, :1].mean(dim=(2, 3), keepdim=True) + level[:, None, None, None]
        return torch.cat([log_depth, out[:, 1:]], dim=1)

    def coarse(self, tokens: Tensor, class_tokens: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """Log depth and log spread ``(B, 2, H/7, W/7)``, and what the upsampling needs."""
        seen, level = self.see(tokens, class_tokens, image)
        return self.tell(seen, level), seen

    def forward(self, tokens: Tensor, class_tokens: Tensor, image: Tensor) -> Tensor:
        """Predict from ``tokens (B, taps, dim, H/14, W/14)``, ``class_tokens (B, taps, dim)``
        and the ImageNet-normalised ``image (B, 3, H, W)``.

        Returns:
            ``(B, 2, H, W)``: natural logarithm of the canonical depth, and of its Laplace spread.
        """
        coarse, features = self.coarse(tokens, class_tokens, image)
        return convex_upsample(coarse, self.weights(features))

    def decode(
        self,
        seen: Tensor,
        level: Tensor | None,
        doubt: Tensor | None = None,
        change: Tensor | None = None,
    ) -> Tensor:
        """What :meth:`forward` gives, from what :meth:`see` gives.

        Args:
            doubt: ``(B, H/7, W/7)`` log spread to take instead of its own.
            change: ``(guide_dim,)`` weights for log depth; what they say is a third channel.
        """
        coarse = self.tell(seen, level)
        if doubt is not None:
            coarse = torch.stack([coarse[:, 0], doubt], dim=1)
        if change is not None:
            coarse = torch.cat([coarse, torch.einsum("c,bchw->bhw", change, seen)[:, None]], dim=1)
        return convex_upsample(coarse, self.weights(seen))


class HeadEnsemble(nn.Module):
    """Heads that learnt from different seeds or sources, averaged.

    Sigma is their geometric mean, or what a :class:`~slamdepth.depth.doubt.Doubt` says where the
    shape has one. What they disagree on adds nothing: heads that know different things differ
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

    def forward(self, tokens: Tensor, class_tokens: Tensor, image: Tensor) -> tuple[Tensor, Tensor]:
        """Mean log depth and its calibrated standard deviation, each ``(B, H, W)``."""
        return self.decode(self.features(tokens, class_tokens, image))

    @property
    def _heads(self) -> Sequence[DepthHead]:
        return cast("Sequence[DepthHead]", self.members)

    def features(self, tokens: Tensor, class_tokens: Tensor, image: Tensor) -> HeadFeatures:
        """What the members' last layers read, and the common doubt where there is one."""
        each = [member.see(tokens, class_tokens, image) for member in self._heads]
        levels = [level for _, level in each if level is not None]
        features = HeadFeatures(
            torch.stack([seen for seen, _ in each]), level=torch.stack(levels) if levels else None
        )
        if self.doubt is None:
            return features
        return replace(features, doubt=self.doubt(tokens[:, -1], self.coarse_log_depth(features)))

    def decode(self, features: HeadFeatures, change: LastLayerChange | None = None) -> tuple[Tensor, Tensor]:
        """What :meth:`forward` gives, from :meth:`features`."""
        changes = [None] * len(self.members) if change is None else change.weights
        outs = torch.stack([
            member.decode(seen, level, features.doubt, own)
            for member, seen, level, own in zip(
                self._heads, features.seen, self._levels(features), changes, strict=True
            )
        ])  # fmt: skip
        mean = outs[:, :, 0].mean(dim=0)
        if change is not None:
            relief = outs[:, :, 2].mean(dim=0)
            mean = mean + relief - relief.mean(dim=(1, 2), keepdim=True) + change.offset
        # A Laplace distribution of spread b has the variance 2 b^2.
        return mean, self.sigma_scale * math.sqrt(2.0) * outs[:, :, 1].mean(dim=0).exp()

    def coarse_log_depth(self, features: HeadFeatures) -> Tensor:
        """Mean log depth ``(B, H/7, W/7)`` of the members before the upsampling."""
        each = zip(self._heads, features.seen, self._levels(features), strict=True)
        return torch.stack([member.tell(seen, level)[:, 0] for member, seen, level in each]).mean(dim=0)

    def _levels(self, features: HeadFeatures) -> Sequence[Tensor | None]:
        return [None] * len(self.members) if features.level is None else list(features.level)


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
    if meta.get("format") not in _READABLE:
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
