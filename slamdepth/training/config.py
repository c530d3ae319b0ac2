# SPDX-License-Identifier: Apache-2.0
"""Settings of one training: frozen, validated, read from YAML."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)

from slamdepth.errors import ConfigError

Supervision = Literal["scale", "shape", "both", "gravity"]
"""What the views of a source supervise. A view's scale is its mean log depth, its shape the rest;
``gravity`` trains the gravity network only, no depth."""

_BLOCKS = 12
"""Transformer blocks of the backbone, a ViT-S."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class AugmentConfig(_Section):
    """Random changes of a training image, made before the backbone sees it."""

    flip: float = Field(0.5, ge=0, le=1, description="share of mirrored images")
    upright_roll_deg: float = Field(6.0, ge=0, le=90, description="deviation of the roll of upright images")
    rolled: float = Field(0.5, ge=0, le=1, description="share of images rolled by up to max_roll_deg")
    max_roll_deg: float = Field(60.0, ge=0, le=180, description="largest in-plane roll")
    max_tilt_deg: float = Field(8.0, ge=0, le=30, description="largest virtual pan and tilt")
    max_zoom: float = Field(1.6, ge=1, le=4, description="largest focal length over the camera's own")
    colour: float = Field(0.4, ge=0, le=1, description="strength of brightness, contrast, tint changes")
    blur: float = Field(0.3, ge=0, le=1, description="share of blurred images")
    noise: float = Field(0.3, ge=0, le=1, description="share of images with sensor noise")
    jpeg: float = Field(0.5, ge=0, le=1, description="share of images compressed as JPEG")
    mixed: float = Field(
        0.0, ge=0, le=1, description="share of views that are composed with another, nearer surfaces in front"
    )
    mixed_again: float = Field(0.35, ge=0, le=1, description="share of those that are composed with a third")


class PlaceConfig(_Section):
    """One place, one camera: a folder of pairs, a sequence or a scene."""

    name: str = Field(description="folder below the data folder")
    samples: int = Field(200, ge=1, description="augmented samples, spread over its frames")


class SourceConfig(_Section):
    """A folder of places. Each source has its own feature cache."""

    folder: str = Field(description="folder of the places; relative to $SLAMDEPTH_DATA if not absolute")
    reader: str | None = Field(
        None, description="layout: pairs, hypersim, synth, tum, 7scenes; recognised from the files if absent"
    )
    places: tuple[PlaceConfig, ...] = Field((), description="places to train on")
    members: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="ensemble members trained on it, counted from 0; all if absent",
    )
    augment: AugmentConfig | None = Field(
        None, description="augmentation of this source's views; view.augment if absent"
    )
    supervision: Supervision = Field(
        "both", description="what its views supervise; mixed views, for example, show no true scale"
    )
    held_out: tuple[str, ...] = Field((), description="places to evaluate on, never trained on")
    limit: int | None = Field(None, ge=1, description="use only this many of the samples, chosen at random")


class ViewConfig(_Section):
    """How an image is presented to the backbone."""

    rows: int = Field(196, ge=28, multiple_of=14, description="height of the network input")
    columns: int = Field(266, ge=28, multiple_of=14, description="width of the network input")
    min_depth_m: float = Field(0.2, gt=0)
    max_depth_m: float = Field(10.0, gt=0)
    augment: AugmentConfig = AugmentConfig()
    upright: bool = Field(
        False,
        description="rotate views upright by their gravity, taken from a place's gravity.txt or estimated "
        "from lines in the image",
    )

    @model_validator(mode="after")
    def _spans_depths(self) -> ViewConfig:
        if self.min_depth_m >= self.max_depth_m:
            raise ValueError(
                f"min_depth_m must be below max_depth_m, got {self.min_depth_m:g} and {self.max_depth_m:g}"
            )
        return self


class HeadConfig(_Section):
    """Shape of the head."""

    taps: tuple[int, ...] = Field((5, 8, 11), min_length=1, description="backbone blocks the head reads")
    dim: int = Field(128, ge=8, le=512, description="channels at token resolution")
    blocks: int = Field(1, ge=0, le=8, description="residual convolutions at token resolution")
    guide_dim: int = Field(64, ge=4, le=256, description="channels of the image guide of the upsampling")
    dropout: float = Field(0.2, ge=0, lt=1, description="share of token channels dropped in training")
    scale_dim: int = Field(
        0, ge=0, le=256, description="channels of the scale branch; 0: scale and shape share all layers"
    )
    gravity: bool = Field(False, description="the head takes the direction of gravity as input")
    unknown_gravity: float = Field(
        0.1, ge=0, le=1, description="share of training samples whose gravity is hidden from the head"
    )
    gravity_dim: int = Field(
        0, ge=0, le=256, description="channels of the network that estimates gravity; 0: no such network"
    )

    @field_validator("taps")
    @classmethod
    def _are_blocks(cls, taps: tuple[int, ...]) -> tuple[int, ...]:
        if taps != tuple(sorted(set(taps))) or not 0 <= taps[0] <= taps[-1] < _BLOCKS:
            raise ValueError(
                f"must be blocks from 0 to {_BLOCKS - 1}, each once, ascending; got {list(taps)}"
            )
        return taps

    @model_validator(mode="after")
    def _gravity_has_its_branch(self) -> HeadConfig:
        if self.gravity and not self.scale_dim:
            raise ValueError("gravity needs a scale_dim above 0")
        return self


class AdapterConfig(_Section):
    """Training of low-rank changes of the backbone's last blocks, together with heads trained before.

    The result lies between the weights it starts from and the mean of all trainings (Wortsman et al., WiSE-FT
    and Model soups, 2022).
    """

    start: str = Field(description="file of the heads that the training starts from")
    first: int = Field(8, ge=1, lt=_BLOCKS, description="first block that is changed")
    rank: int = Field(16, ge=1, le=64, description="rank of the changes of each training")
    runs: int = Field(1, ge=1, le=8, description="trainings from different seeds, averaged")
    share: float = Field(0.6, gt=0, le=1, description="share of their mean in the result")
    learning_rate: float = Field(5e-4, gt=0, description="peak rate of the changes")
    weight_decay: float = Field(0.05, ge=0, description="of the changes")


class LossConfig(_Section):
    """Weights of the loss terms."""

    nll: float = Field(1.0, ge=0, description="Laplace likelihood of log depth with its uncertainty")
    scale_invariant: float = Field(1.0, ge=0, description="variance-reduced squared log error")
    scale_invariant_lambda: float = Field(0.5, ge=0, le=1)
    gradient: float = Field(0.5, ge=0, description="multi-scale gradients of the log error")


class SearchRange(_Section):
    """Search space of one setting: from ``low`` to ``high``, or one of ``choices``."""

    low: float | None = None
    high: float | None = None
    log: bool = Field(False, description="sample uniformly in the logarithm")
    choices: tuple[float, ...] | None = Field(None, min_length=1)

    @model_validator(mode="after")
    def _one_of_two(self) -> SearchRange:
        bounds = (self.low, self.high)
        if self.choices is not None:
            if bounds != (None, None) or self.log:
                raise ValueError("give either choices or low and high")
        elif self.low is None or self.high is None or self.low >= self.high:
            raise ValueError("needs low and a higher high, or choices")
        elif self.log and self.low <= 0:
            raise ValueError("log needs a low above 0")
        return self


class TrainConfig(_Section):
    """Settings of one training run."""

    seed: int = Field(0, ge=0)
    members: int = Field(1, ge=1, le=16, description="heads trained from different seeds and averaged")
    coarse_epochs: int = Field(
        10, ge=0, description="epochs with the loss at 1/7 resolution, before upsampling"
    )
    fine_epochs: int = Field(
        1, ge=0, description="epochs at full resolution after them, which train the upsampling only"
    )
    batch: int = Field(16, ge=1)
    learning_rate: float = Field(
        2e-3, gt=0, description="peak rate, of the coarse epochs and again of the fine ones"
    )
    weight_decay: float = Field(0.05, ge=0)
    uncertainty: Literal["own", "out_of_fold"] = Field(
        "own", description="each member's own, or that combined with one fitted to errors in left-out places"
    )
    sigma_scale: float = Field(
        1.0,
        gt=0,
        description="calibration of sigma; measured where there are held-out places or out_of_fold, and kept "
        "with adapters",
    )
    backbone: str | None = Field(None, description="weights file; the cached backbone if absent")
    trained_on: str = Field(
        "", description="training data as shown wherever the head is used; its places if empty"
    )
    licence: str = Field("unknown", description="licence of the head")
    output: str = Field(description="file the head is written to")
    sources: tuple[SourceConfig, ...] = Field(min_length=1)
    view: ViewConfig = ViewConfig()
    head: HeadConfig = HeadConfig()
    adapters: AdapterConfig | None = Field(
        None, description="go on from trained heads and adapt the backbone's last blocks to them"
    )
    loss: LossConfig = LossConfig()
    search: dict[str, SearchRange] = Field(
        {}, description="settings tuned by --search, by dotted name, such as head.dim"
    )

    @field_validator("fine_epochs")
    @classmethod
    def _trains_at_all(cls, fine_epochs: int, info: ValidationInfo) -> int:
        if fine_epochs == 0 and info.data.get("coarse_epochs") == 0:
            raise ValueError("at least one epoch is needed, and coarse_epochs is 0 too")
        return fine_epochs

    @field_validator("head")
    @classmethod
    def _knows_gravity(cls, head: HeadConfig, info: ValidationInfo) -> HeadConfig:
        view = info.data.get("view")
        if (head.gravity or head.gravity_dim) and view is not None and not view.upright:
            raise ValueError("gravity and gravity_dim need 'view: {upright: true}', which determines gravity")
        return head

    @field_validator("adapters")
    @classmethod
    def _adapts_what_is_read(
        cls, adapters: AdapterConfig | None, info: ValidationInfo
    ) -> AdapterConfig | None:
        if adapters is None or not {"head", "sources", "fine_epochs", "uncertainty"} <= info.data.keys():
            return adapters
        if info.data["head"].taps[-1] < adapters.first:
            raise ValueError(f"no tap of 'head.taps' reads block {adapters.first} or a later one")
        if info.data["fine_epochs"]:
            raise ValueError("needs 'fine_epochs: 0': the upsampling is that of the heads it starts from")
        if info.data["uncertainty"] != "own":
            raise ValueError("needs 'uncertainty: own': that of the heads it starts from is kept")
        if any(source.supervision == "gravity" or source.members for source in info.data["sources"]):
            raise ValueError("sources train all heads and their depth, not single 'members' or gravity")
        return adapters

    @field_validator("search")
    @classmethod
    def _are_searchable(cls, search: dict[str, SearchRange]) -> dict[str, SearchRange]:
        for name in search:
            if name not in SEARCHABLE:
                raise ValueError(f"'{name}' cannot be searched; choose from: {', '.join(SEARCHABLE)}")
        return search

    @field_validator("sources")
    @classmethod
    def _have_their_members(
        cls, sources: tuple[SourceConfig, ...], info: ValidationInfo
    ) -> tuple[SourceConfig, ...]:
        count = info.data.get("members")
        for source in sources:
            for member in source.members or ():
                if count is not None and not 0 <= member < count:
                    there_are = f"there are members 0 to {count - 1}"
                    raise ValueError(f"'{source.folder}' names member {member}, and {there_are}")
        return sources

    @classmethod
    def from_yaml(cls, path: str | Path) -> TrainConfig:
        """Read and validate the YAML file ``path``.

        Raises:
            ConfigError: the file cannot be read, or a setting is unknown, missing or out
                of range. The message names it.
        """
        path = Path(path)
        try:
            loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ConfigError(f"{path}: cannot read the settings: {error.strerror}") from error
        except (yaml.YAMLError, UnicodeDecodeError) as error:
            raise ConfigError(f"{path}: not valid YAML: {str(error).splitlines()[0]}") from error
        return cls.from_dict(loaded if loaded is not None else {}, origin=str(path))

    @classmethod
    def from_dict(cls, values: Any, origin: str = "settings") -> TrainConfig:
        """Validate nested ``values``; ``origin`` is named in errors.

        Raises:
            ConfigError: a setting is unknown, missing or out of range. The message names it.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            problem = error.errors()[0]
            name = ".".join(str(part) for part in problem["loc"]) or "(top level)"
            message = problem["msg"].removeprefix("Value error, ")
            what = "unknown setting" if problem["type"] == "extra_forbidden" else message
            raise ConfigError(f"{origin}: setting '{name}': {what}") from error


def _numbers(section: type[BaseModel], prefix: str = "", left_out: tuple[str, ...] = ()) -> dict[str, bool]:
    kinds = {key: field.annotation for key, field in section.model_fields.items() if key not in left_out}
    return {prefix + key: kind is int for key, kind in kinds.items() if kind in (int, float)}


# Excluded: settings that change the features, the places or the size of the file.
SEARCHABLE: dict[str, bool] = {
    **_numbers(TrainConfig, left_out=("seed", "members", "sigma_scale")),
    **_numbers(HeadConfig, "head.", left_out=("gravity_dim",)),
    **_numbers(LossConfig, "loss."),
}
"""Searchable settings by dotted name; True for whole numbers."""


def digest(section: BaseModel, *more: object) -> str:
    """Short hash of settings and further items; names the caches and checkpoints made with them."""
    text = json.dumps([section.model_dump(mode="json"), [str(item) for item in more]], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
