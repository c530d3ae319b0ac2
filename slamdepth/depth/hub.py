# SPDX-License-Identifier: Apache-2.0
"""Any depth model that transformers knows (an optional dependency), as a depth model of this package.

Strict: every tensor that a network uses must be there in its shape. No code of a model is run, and nothing is
downloaded.
"""

from __future__ import annotations

import json
import logging
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from slamdepth.depth import hub_store as hub
from slamdepth.depth.card import ModelCard, StatedFacts
from slamdepth.depth.checkpoints import check_device, read_checkpoint
from slamdepth.depth.hub_card import DEPTH_PRO, STATED, card_of_config
from slamdepth.depth.hub_input import InputRule, read_rule, restored, usual_rule
from slamdepth.depth.hub_models import BY_NAME, BY_REPO, METRIC, HubModel
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.registry import register
from slamdepth.depth.weights import cache_dir
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.types import Camera, WeightsInfo

_log = logging.getLogger(__name__)

_UNUSED = re.compile(r"neck\.fusion_stage\.layers\.0\.residual_layer1\..*|(.*\.)?mask_token")
"""Parameters that files may lack: the first fusion of a DPT has no second input, whose residual unit they
are, and only the training of a DINOv2 masks."""


@dataclass(frozen=True)
class HubFiles:
    """What a model is made from, read and checked.

    Attributes:
        origin: the folder or file, named in errors.
        config: of the network, as transformers knows it.
        tensors: by the names of the hub.
        rule: how images are prepared.
        card: its facts.
        weights: the files.
    """

    origin: str
    config: dict[str, Any]
    tensors: dict[str, torch.Tensor]
    rule: InputRule
    card: ModelCard
    weights: tuple[WeightsInfo, ...]


class HubDepth(NetworkDepth):
    """A network of transformers as a depth model.

    Args:
        network: in eval mode.
        files: what it was made from.
        device: where it runs.
    """

    def __init__(self, network: torch.nn.Module, files: HubFiles, device: str = "cpu") -> None:
        super().__init__(files.card, files.weights, device)
        self._network = network.to(device)
        self._rule = files.rule
        self._is_depth_pro = files.config.get("model_type") == DEPTH_PRO

    @classmethod
    def load(cls, name: str, *, weights: Path | None = None, device: str = "cpu") -> HubDepth:
        """Read a model from this machine; nothing is downloaded.

        Args:
            name: a short name, ``hf:ORG/NAME``, ``hf:FOLDER`` or a folder.
            weights: a folder in the hub's layout, or the file that the authors of Depth Anything V2 publish;
                for short names and ``hf:ORG/NAME`` only. Default: what is in the cache folder.
            device: where the network runs.

        Raises:
            WeightsError: it is missing, damaged, of another layout, or does not say what its values mean.
            ConfigError: the extra is not installed, or the device is not available.
        """
        check_device(device)
        if not hub.has_extra():
            raise ConfigError(f"depth model '{name}' needs transformers: install it with {hub.EXTRA}")
        files = _find(name, weights)
        return cls(build_network(files.config, files.tensors, files.origin), files, device)

    def focal_px(self, camera: Camera, size: tuple[int, int]) -> float:
        """Focal length in pixels at ``size``; Depth Pro measures it along the width alone."""
        if self._is_depth_pro:
            return float(camera.fx * size[1] / camera.width)
        return super().focal_px(camera, size)

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        height, width = image_rgb.shape[:2]
        prepared = self._rule.prepare(image_rgb, self.card.native_size, self.device)
        with torch.inference_mode():
            values = restored(self._network(prepared.pixels).predicted_depth, prepared, height, width)
            if self._is_depth_pro:  # inverse depth at a focal length of one image width
                values = 1.0 / values.clamp(1e-4, 1e4)
        return values.cpu().numpy(), prepared.size


def _find(name: str, weights: Path | None) -> HubFiles:
    folder = hub.local_folder(name)
    if folder is not None:
        if weights is not None:
            raise ConfigError(f"depth model '{name}' names its folder already; leave out the weights")
        return _read(folder, f"{hub.PREFIX}{folder.resolve().name}", _known_by_folder(folder))
    reference = hub.reference_of(name)
    known = reference.known
    if weights is not None and weights.is_dir():
        return _read(weights, name, known)
    official = weights
    if official is None:
        if (found := hub.find_folder(reference)) is not None:
            return _read(found, name, known)
        official = hub.official_file(reference)
    stem = known.official if known else None
    if official is None or not official.is_file():
        if weights is not None:
            raise WeightsError(f"{weights}: no such weights file or folder for depth model '{name}'")
        raise hub.missing(reference, f", or {stem}.pth into {cache_dir()}" if stem else "")
    if known is None or stem is None:
        raise WeightsError(f"{official}: depth model '{name}' takes a folder with {reference.files}")
    return _read_official(official, name, known)


def _known_by_folder(folder: Path) -> HubModel | None:
    """The table's entry for a local folder: that of what was pulled into it, or of its own name."""
    record = hub.read_record(folder)
    if record is not None:
        return BY_REPO.get(record.repo.lower())
    own = folder.resolve().name.lower()
    found = next((model for repo, model in BY_REPO.items() if repo.partition("/")[2] == own), None)
    if found is not None:
        _log.info("%s: taken for %s by its name", folder, found.repo)
    return found


def _read(folder: Path, name: str, known: HubModel | None) -> HubFiles:
    path = folder / hub.CONFIG
    try:
        config = json.loads(path.read_text(encoding="utf-8"))
        if not isinstance(config, dict):
            raise ValueError("not a table")
    except FileNotFoundError as error:
        raise WeightsError(f"{folder}: no model in the hub's layout: it has no {hub.CONFIG}") from error
    except (OSError, ValueError) as error:
        raise WeightsError(f"{path}: not readable as JSON: {error}") from error
    stated = None
    if (folder / STATED).is_file():
        stated = StatedFacts.read(folder / STATED)
    rule = read_rule(folder, str(config.get("model_type")))
    card = card_of_config(name, config, rule, str(folder), known, stated)
    tensors: dict[str, torch.Tensor] = {}
    infos = []
    for file in hub.weights_files(folder):
        if not file.is_file():
            raise WeightsError(f"{file}: this part of the weights is missing")
        digest = hub.checked_sha256(file)
        if known is not None and known.sha256 not in (None, digest) and hub.read_record(folder) is None:
            _log.warning("%s: not the file that is pinned for %s (its sha256 differs)", file, known.repo)
        infos.append(WeightsInfo(known.repo if known else folder.name, digest, card.trained_on, card.licence))
        tensors |= read_checkpoint(file)
    return HubFiles(str(folder), config, tensors, rule, card, tuple(infos))


def _read_official(path: Path, name: str, known: HubModel) -> HubFiles:
    from slamdepth.depth.hub_official import check_name, depth_anything_config, depth_anything_tensors
    from slamdepth.io import sha256_of

    check_name(path, name, known)
    theirs = read_checkpoint(path)
    config = depth_anything_config(theirs, str(path), known.training.far_m if known.kind is METRIC else None)
    tensors = depth_anything_tensors(theirs, str(path))
    rule = usual_rule("depth_anything")
    card = card_of_config(name, config, rule, str(path), known)
    info = WeightsInfo(path.stem, sha256_of(path), card.trained_on, card.licence)
    return HubFiles(str(path), config, tensors, rule, card, (info,))


def build_network(settings: dict[str, Any], tensors: dict[str, torch.Tensor], origin: str) -> torch.nn.Module:
    """Build a network and load its tensors: every one it uses, in its shape.

    Args:
        settings: the content of its ``config.json``.
        tensors: by the names of the hub.
        origin: its folder or file, named in errors.

    Returns:
        The network in float32 and eval mode, frozen.

    Raises:
        WeightsError: transformers does not know it, or a tensor is missing or misshapen; names the first.
    """
    import transformers

    model_type = str(settings.get("model_type"))
    try:
        with _quietly():
            config = transformers.CONFIG_MAPPING[model_type].from_dict(settings)
            if model_type == DEPTH_PRO:
                config.use_fov_model = False  # the camera's own focal length is used
            build = transformers.MODEL_FOR_DEPTH_ESTIMATION_MAPPING[type(config)]
            network, found = build.from_pretrained(
                None,
                config=config,
                state_dict=tensors,
                output_loading_info=True,
                ignore_mismatched_sizes=True,
            )
    except Exception as error:  # whatever a configuration or a network raises
        first = (str(error).strip().splitlines() or [""])[0][:200]  # lists of all models may follow
        raise WeightsError(
            f"{origin}: transformers {transformers.__version__} builds no depth network of type "
            f"'{model_type}' from it: {type(error).__name__}: {first}"
        ) from error
    missing = sorted(name for name in found["missing_keys"] if not _UNUSED.fullmatch(name))
    misshapen = sorted(one if isinstance(one, str) else one[0] for one in found["mismatched_keys"])
    problems = [
        f"{len(names)} {what} (first: {names[0]})"
        for what, names in (("missing", missing), ("misshapen", misshapen))
        if names
    ]
    if problems:
        raise WeightsError(f"{origin}: not the tensors that this network needs: {'; '.join(problems)}")
    if extra := sorted(found["unexpected_keys"]):
        _log.warning("%s: %d tensors are not used (first: %s)", origin, len(extra), extra[0])
    module: torch.nn.Module = network.float().eval().requires_grad_(False)
    return module


@contextmanager
def _quietly() -> Iterator[None]:
    """Without the progress bars and reports of transformers: what they say is checked here."""
    from transformers.utils import logging as theirs

    level, bars = theirs.get_verbosity(), theirs.is_progress_bar_enabled()
    theirs.set_verbosity(logging.CRITICAL)
    theirs.disable_progress_bar()
    try:
        yield
    finally:
        theirs.set_verbosity(level)
        if bars:
            theirs.enable_progress_bar()


def create(name: str, *, device: str = "cpu", seed: int = 0, weights: Path | None = None) -> HubDepth:
    """The model called ``name``, see :meth:`HubDepth.load`; nothing is random, so ``seed`` has no effect."""
    del seed
    return HubDepth.load(name, weights=weights, device=device)


for _name in BY_NAME:
    register(_name)(partial(create, _name))
