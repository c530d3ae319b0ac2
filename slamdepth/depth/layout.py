# SPDX-License-Identifier: Apache-2.0
"""Layouts of weights files: names and shapes of their tensors, the strict check of them, and the header."""

from __future__ import annotations

import json
from collections.abc import Mapping

from slamdepth.errors import WeightsError

Shape = tuple[int, ...]

_HEADER_KEY = "slamdepth"


def dinov2_layout(dim: int = 384, depth: int = 12, patch: int = 14, grid: int = 37) -> dict[str, Shape]:
    """Tensor names and shapes of an official DINOv2 ViT file without registers.

    The official file also has a tensor ``mask_token``, which only training uses.
    """
    shapes: dict[str, Shape] = {
        "cls_token": (1, 1, dim),
        "pos_embed": (1, 1 + grid * grid, dim),
        "patch_embed.proj.weight": (dim, 3, patch, patch),
        "patch_embed.proj.bias": (dim,),
        "norm.weight": (dim,),
        "norm.bias": (dim,),
    }
    for index in range(depth):
        block = f"blocks.{index}."
        for name in ("norm1.weight", "norm1.bias", "ls1.gamma", "norm2.weight", "norm2.bias", "ls2.gamma"):
            shapes[block + name] = (dim,)
        for name, out_dim, in_dim in (
            ("attn.qkv", 3 * dim, dim),
            ("attn.proj", dim, dim),
            ("mlp.fc1", 4 * dim, dim),
            ("mlp.fc2", dim, 4 * dim),
        ):
            shapes[f"{block}{name}.weight"] = (out_dim, in_dim)
            shapes[f"{block}{name}.bias"] = (out_dim,)
    return shapes


def check_layout(
    found: Mapping[str, Shape],
    expected: Mapping[str, Shape],
    origin: str,
    *,
    ignored: tuple[str, ...] = (),
) -> None:
    """Check that a file has exactly the tensors that a network needs.

    Args:
        found: shapes of the file's tensors, by name.
        expected: shapes of the network's tensors, by name.
        origin: the file, named in errors.
        ignored: names that may be there and are not used.

    Raises:
        WeightsError: a tensor is missing, extra or misshapen; names the first of each kind and says how many
            there are.
    """
    missing = [name for name in expected if name not in found]
    extra = [name for name in found if name not in expected and name not in ignored]
    misshapen = [name for name in expected if name in found and tuple(found[name]) != tuple(expected[name])]
    problems = []
    if missing:
        problems.append(f"{len(missing)} missing (first: {missing[0]} {expected[missing[0]]})")
    if extra:
        problems.append(f"{len(extra)} unexpected (first: {extra[0]} {tuple(found[extra[0]])})")
    if misshapen:
        name = misshapen[0]
        problems.append(
            f"{len(misshapen)} misshapen (first: {name} is {tuple(found[name])}, not {expected[name]})"
        )
    if problems:
        raise WeightsError(f"{origin}: not the layout this network needs: tensors {'; '.join(problems)}")


def pack_about(about: Mapping[str, str]) -> dict[str, str]:
    """A file's header ``about`` as safetensors metadata, under a single key.

    safetensors writes several keys in random order, while the same training must give the same bytes.
    """
    return {_HEADER_KEY: json.dumps(dict(about), sort_keys=True)}


def unpack_about(metadata: Mapping[str, str] | None) -> dict[str, str]:
    """The header of a file from its safetensors metadata; empty for a file of another origin."""
    try:
        about = json.loads((metadata or {}).get(_HEADER_KEY, "{}"))
    except ValueError:
        return {}
    return {str(key): str(value) for key, value in about.items()} if isinstance(about, dict) else {}
