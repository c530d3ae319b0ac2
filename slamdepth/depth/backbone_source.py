# SPDX-License-Identifier: Apache-2.0
"""The DINOv2 ViT-S/14 from its publisher, and the check that it is the one that the heads were trained on.

Python's own ``urllib`` downloads it, through the proxies of ``HTTPS_PROXY``.
"""

from __future__ import annotations

import hashlib
import http.client
import logging
import os
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.error import HTTPError, URLError

import numpy as np

from slamdepth.io import sha256_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

_log = logging.getLogger(__name__)

URL = "https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth"
SHA256 = "b938bf1bc15cd2ec0feacfe3a1bb553fe8ea9ca46a7e1d8d00217f29aef60cd9"
TENSORS_SHA256 = "0c8ddfa35ae1b661479faedc8e1c9bbb286433a3393ba47407ce9165dee8920a"
"""Of the tensors of the wheel's backbone, by :func:`tensors_sha256`."""

TIMEOUT_S = 8.0
_BLOCK = 1 << 20


def tensors_sha256(tensors: Mapping[str, NDArray[np.float32]]) -> str:
    """A checksum of tensors, whatever file they come from: of names, shapes and values as little-endian
    float32, in the order of the names."""
    digest = hashlib.sha256()
    for name in sorted(tensors):
        value = np.ascontiguousarray(tensors[name], dtype="<f4")
        digest.update(f"{name} {value.shape}\n".encode())
        digest.update(value.tobytes())
    return digest.hexdigest()


def published_backbone(
    folder: Path, report: Callable[[str, float], None]
) -> dict[str, NDArray[np.float32]] | None:
    """The tensors of the official file, by name; None, with a message in the log, where it cannot be had.

    Args:
        folder: takes the download while it is not complete; a later call goes on from there.
        report: called before the download.

    Raises:
        OSError: ``folder`` cannot be written.
    """
    from slamdepth.depth.checkpoints import read_checkpoint

    part = folder / (URL.rsplit("/", 1)[1] + ".part")
    report("downloading from its publisher", 0.0)
    try:
        _download(URL, part)
    except (URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
        _log.info("%s cannot be reached (%s); taken from elsewhere", URL, error)
        return None
    complete = part.with_suffix("")
    if sha256_of(part) != SHA256:
        part.unlink()
        _log.warning("%s: the sha256 is not the known one; taken from elsewhere", URL)
        return None
    os.replace(part, complete)
    try:
        tensors = {name: value.float().numpy() for name, value in read_checkpoint(complete).items()}
    finally:
        complete.unlink()
    tensors.pop("mask_token", None)  # used in training only
    if tensors_sha256(tensors) != TENSORS_SHA256:
        _log.warning("%s: not the numbers that the heads were trained on; taken from elsewhere", URL)
        return None
    return tensors


def _download(url: str, part: Path) -> None:
    done = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={done}-"} if done else {})
    try:
        answer = urllib.request.urlopen(request, timeout=TIMEOUT_S)
    except HTTPError as error:
        if error.code == 416:  # nothing is left to download
            return
        raise
    with answer, part.open("ab" if answer.status == 206 else "wb") as file:
        left = int(answer.headers.get("Content-Length", 0))
        while block := answer.read(_BLOCK):
            file.write(block)
            left -= len(block)
    if left > 0:
        raise http.client.IncompleteRead(b"", left)
