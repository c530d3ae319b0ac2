# SPDX-License-Identifier: Apache-2.0
"""The published depth models that have a short name or whose own files do not say what they predict.

Revisions and checksums are those that public projects pin for these files; models without them are pinned
when they are first pulled. Sources of focal lengths: Hypersim 886.81 px at 1024x768, Virtual KITTI 2 725.0087
px at 1242x375, NYU Depth v2 518.8579 px at 640x480, KITTI 721.5377 px at 1242x375.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

from slamdepth.types import DepthKind

METRIC, INVERSE = DepthKind.METRIC, DepthKind.AFFINE_INVERSE_DEPTH

NC = "CC-BY-NC-4.0"


@dataclass(frozen=True)
class Training:
    """What the files of a model do not say of its training.

    Attributes:
        data: the data.
        size: rows and columns of the network's input.
        focal_px: focal length in pixels of images of ``size``; None where there is no single one.
        far_m: farthest depth that is predicted; None where it is not bounded or not metric.
    """

    data: str
    size: tuple[int, int]
    focal_px: float | None = None
    far_m: float | None = None


@dataclass(frozen=True)
class HubModel:
    """A published model.

    Attributes:
        name: short name for ``--depth``; None where it has none.
        repo: its place on the hub, ``ORG/NAME``.
        kind: what its values mean.
        licence: of the weights.
        training: what it was trained on.
        revision: the commit that is fetched; None takes the newest.
        sha256: of its weights file at that commit, or None.
        official: stem of the file that its authors publish elsewhere in their own layout, if that is read.
    """

    name: str | None
    repo: str
    kind: DepthKind
    licence: str
    training: Training
    revision: str | None = None
    sha256: str | None = None
    official: str | None = None


_HYPERSIM = Training("Hypersim", (518, 686), 886.81 * math.sqrt((518 / 768) * (686 / 1024)), 20.0)
_VKITTI = Training("Virtual KITTI 2", (518, 1722), 725.0087 * math.sqrt((518 / 375) * (1722 / 1242)), 80.0)
_NYU = Training("NYU Depth v2", (480, 640), 518.8579, 10.0)
_KITTI = Training("KITTI", (375, 1242), 721.5377, 80.0)
_MIXED = "pseudo labels on 62 M images of eight public sets, by a teacher of five synthetic sets"
_MIDAS = "up to twelve public sets of relative depth (MiDaS)"

_PINNED = {
    "Depth-Anything-V2-Small": (
        "5426e4f0f36572d16453bbda7a8389317b1bef99",
        "3152477ce0d8d6978d76b995120de97cb5b928701fd0f817769f59e249a16b70",
    ),
    "Depth-Anything-V2-Metric-Indoor-Small": (
        "8078d68a9c75a972131914f6afd0c1723be0da7f",
        "e990eb82fbf11b05b7813261196a2b841bdcf5a05f64396724a8987fa90504a3",
    ),
    "Depth-Anything-V2-Metric-Indoor-Base": (
        "c6d9784685727bfc6d0a7b5452ce94afaee1e7f5",
        "8b902f5d9a8c8a9520f3a8c6a00afe442b464eff5aaf0cb405d1da721cd9f79f",
    ),
    "Depth-Anything-V2-Metric-Indoor-Large": (
        "d2fc6a93601aabb1139a3bf0ebfcb4e89c67817f",
        "04d3295ff4f9cbee72b8998a85930fe870b45ba4431e7af47415fbded02388ca",
    ),
    "Depth-Anything-V2-Metric-Outdoor-Small": (
        "fd2c22027eaf20374204f14099b8341e1925ad39",
        "ad065c77a7421ca55159a1f0db9433397a607690f2d76bb8a6fc54b1be7a3124",
    ),
    "Depth-Anything-V2-Metric-Outdoor-Base": (
        "5b575fded0346068343a6d96d0ce3ab6dbc9fb49",
        "1f2e9ed13ee39126686994669f8d1bfd9cd8f093a4d2a0891e5a0e5263b480c9",
    ),
    "Depth-Anything-V2-Metric-Outdoor-Large": (
        "4eab4cf1983c2801c515804005214de56a4b67cc",
        "15f7de4b22f1b1194847ea694ee9ed6395563ba5cd52b70b87901f183c232c9a",
    ),
    "zoedepth-nyu": (
        "52ae69caf7896c927909b3ceab4249c235e16dc1",
        "b616e347efc30e64822be28d2464c2fcd0b665b5fdbc9a135d53d168c31c77ab",
    ),
    "zoedepth-kitti": (
        "0347db85b019f309d5544c70ad2ac998ad570899",
        "8427d1e398736f909cc7432276981417b2e7ec698b4d70786022142def78fe38",
    ),
    "zoedepth-nyu-kitti": (
        "f364d4c7936e91f465abba182208dd68142bf0ca",
        "c5494fa0938f18d71e215e245472470c3aefebd7b434abd89750e5ae4008e2dc",
    ),
    "dpt-dinov2-small-nyu": (
        "21a14468819a6aa4a1bbe56d872ba8be23184b0f",
        "16f263f1793476fe83a10c02da0897573935b4ddb640123c213b39f672649e2a",
    ),
    "dpt-dinov2-small-kitti": (
        "c0d86b8c609b96365202ba99a2065e2b549ad782",
        "d75e96bdb1355fb9075aa3ecd727daa78fbd2887f6c02dbf410aa4b0237a6ba8",
    ),
}
"""Commit and sha256 of the weights file, by the repository's name without ``-hf``."""


def _pins(repo: str) -> tuple[str | None, str | None]:
    return _PINNED.get(repo, (None, None))


def _depth_anything() -> Iterator[HubModel]:
    relative = Training(_MIXED, (518, 518))
    for size, code, licence in (("Small", "vits", "Apache-2.0"), ("Base", "vitb", NC), ("Large", "vitl", NC)):
        for scene, word, training in (
            ("", "", relative),
            ("Metric-Indoor", "metric_hypersim", _HYPERSIM),
            ("Metric-Outdoor", "metric_vkitti", _VKITTI),
        ):
            repo = "-".join(part for part in ("Depth-Anything-V2", scene, size) if part)
            name = "-".join(part for part in ("depth-anything-v2", size, scene) if part).lower()
            official = "_".join(part for part in ("depth_anything_v2", word, code) if part)
            kind = METRIC if scene else INVERSE
            yield HubModel(
                name, f"depth-anything/{repo}-hf", kind, licence, training, *_pins(repo), official=official
            )


def _others() -> Iterator[HubModel]:
    near = Training("12 sets of relative depth, then NYU Depth v2", (384, 512), 415.0863)
    far = Training("12 sets of relative depth, then KITTI", (384, 768), 598.8941, 80.0)
    both = Training("12 sets of relative depth, then NYU Depth v2 and KITTI", (384, 512))
    # No short names for the models of KITTI alone: the scripts that made their files write a range of 10 m.
    for repo, training in (("zoedepth-nyu", near), ("zoedepth-kitti", far), ("zoedepth-nyu-kitti", both)):
        short = None if training is far else repo
        yield HubModel(short, f"Intel/{repo}", METRIC, "MIT", training, *_pins(repo))
    # Depth Pro predicts depth over the focal length in image widths, so f is 1536 px at a width of 1536.
    many = Training("8 real and 12 synthetic sets", (1536, 1536), 1536.0)
    yield HubModel("depth-pro", "apple/DepthPro-hf", METRIC, "Apple AMLR (research only)", many)
    for size in ("small", "base", "large", "giant"):
        for data, training in (("nyu", _NYU), ("kitti", _KITTI)):
            repo = f"dpt-dinov2-{size}-{data}"
            short = ("dinov2-dpt" if data == "nyu" else "dinov2-dpt-kitti") if size == "small" else None
            yield HubModel(short, f"facebook/{repo}", METRIC, "Apache-2.0", training, *_pins(repo))
    for data, training in (("nyu", _NYU), ("kitti", _KITTI)):
        short = "glpn-nyu" if data == "nyu" else None
        yield HubModel(short, f"vinvino02/glpn-{data}", METRIC, "Apache-2.0", training)
    for repo, licence, side in (
        ("dpt-large", "Apache-2.0", 384),
        ("dpt-hybrid-midas", "Apache-2.0", 384),
        ("dpt-beit-base-384", "MIT", 384),
        ("dpt-beit-large-384", "MIT", 384),
        ("dpt-beit-large-512", "MIT", 512),
        ("dpt-swinv2-tiny-256", "MIT", 256),
        ("dpt-swinv2-base-384", "MIT", 384),
        ("dpt-swinv2-large-384", "MIT", 384),
    ):
        short = repo if repo == "dpt-large" else None
        yield HubModel(short, f"Intel/{repo}", INVERSE, licence, Training(_MIDAS, (side, side)))


MODELS: tuple[HubModel, ...] = (*_depth_anything(), *_others())
BY_NAME = {model.name: model for model in MODELS if model.name is not None}
BY_REPO = {model.repo.lower(): model for model in MODELS}

AUTO = (
    "depth-anything-v2-large-metric-indoor",
    "depth-anything-v2-base-metric-indoor",
    "zoedepth-nyu-kitti",
    "zoedepth-nyu",
    "depth-anything-v2-small-metric-indoor",
)
"""Metric models for ``--depth auto``, the best first by what their authors report of rooms never seen in
training; none was measured here. Left out are models trained outdoors only, since this is for rooms, and
Depth Pro, which takes minutes for a keyframe on a CPU."""
