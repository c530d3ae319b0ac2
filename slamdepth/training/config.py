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

Teaches = Literal["relief", "level", "both", "down"]
"""What is learnt from views: the relief of each, its mean log depth (so its scale), both, or none of it
but which way is down."""


_BLOCKS = 12
"""Of the backbone, a ViT-S."""


class _Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class AugmentConfig(_Section):
    """What is done to a training image before the backbone sees it."""

    flip: float = Field(0.5, ge=0, le=1, description="share of mirrored images")
    upright_roll_deg: float = Field(6.0, ge=0, le=90, description="deviation of the roll of upright images")
    rolled: float = Field(0.5, ge=0, le=1, description="share of images rolled by up to max_roll_deg")
    max_roll_deg: float = Field(60.0, ge=0, le=180, description="largest in-plane roll")
    max_tilt_deg: float = Field(8.0, ge=0, le=30, description="largest virtual pan and tilt")
    max_zoom: float = Field(1.6, ge=1, le=4, description="largest focal length over the camera's own")
    colour: float = Field(0.4, ge=0, le=1, description="strength of brightness, contrast, tint changes")
    blur: float = Field(0.3, ge=0, le=1, description="share of blurred images")
    noise: float = Field(0.3, ge=0, le=1, description="share of images with sensor noise")
    jpeg: float = Field(0.5, ge=0, le=1, description="share of images compressed again")
    mixed: float = Field(
        0.0, ge=0, le=1, description="share of views into which another is put, the nearer surface in front"
    )
    mixed_again: float = Field(0.35, ge=0, le=1, description="share of those into which a third is put")


class PlaceConfig(_Section):
    """One place, one camera: a folder of pairs, a sequence or a scene."""

    name: str = Field(description="folder below the data folder")
    samples: int = Field(200, ge=1, description="augmented samples drawn from it, spread over its frames")


class SourceConfig(_Section):
    """A folder of places. Each source has a feature cache of its own."""

    folder: str = Field(description="folder of the places; relative to $SLAMDEPTH_DATA if not absolute")
    reader: str | None = Field(
        None, description="layout: pairs, hypersim, synth, tum, 7scenes; found out from the files if absent"
    )
    places: tuple[PlaceConfig, ...] = Field((), description="trained on")
    members: tuple[int, ...] | None = Field(
        None,
        min_length=1,
        description="heads that learn from it, from 0; all if absent: heads that know "
        "different things are worth more together than heads that differ by seed",
    )
    augment: AugmentConfig | None = Field(None, description="of this source's views; view.augment if absent")
    teaches: Teaches = Field(
        "both", description="what is learnt from it: mixed views, say, show no true scale"
    )
    held_out: tuple[str, ...] = Field((), description="places judged on after training, never trained on")
    limit: int | None = Field(
        None, ge=1, description="only so many of the samples, a random choice; leaves the others' views alone"
    )


class ViewConfig(_Section):
    """How a pair is shown to the backbone."""

    rows: int = Field(196, ge=28, multiple_of=14, description="height of the network input")
    columns: int = Field(266, ge=28, multiple_of=14, description="width of the network input")
    min_depth_m: float = Field(0.2, gt=0)
    max_depth_m: float = Field(10.0, gt=0)
    augment: AugmentConfig = AugmentConfig()
    upright: bool = Field(
        False,
        description="views are turned upright by their gravity, which a place's gravity.txt or lines in "
        "the image tell",
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

    taps: tuple[int, ...] = Field((5, 8, 11), min_length=1, description="backbone blocks it reads")
    dim: int = Field(128, ge=8, le=512, description="channels at token resolution")
    blocks: int = Field(1, ge=0, le=8, description="residual convolutions at token resolution")
    guide_dim: int = Field(64, ge=4, le=256, description="channels that carry image edges to the upsampling")
    dropout: float = Field(0.2, ge=0, lt=1, description="share of token channels dropped in training")
    level_dim: int = Field(
        0, ge=0, le=256, description="channels of a branch that tells a view's scale apart from its relief; "
        "0: both are told by the same layers",
    )  # fmt: skip
    gravity: bool = Field(False, description="the head is told where down is")
    unknown_gravity: float = Field(
        0.1, ge=0, le=1, description="share of training samples for which the head is not told"
    )
    down_dim: int = Field(
        0, ge=0, le=256, description="channels of a network that finds out which way is down; 0: there is "
        "none, and the head is never told",
    )  # fmt: skip

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
        if self.gravity and not self.level_dim:
            raise ValueError("gravity needs a level_dim above 0")
        return self


class LossConfig(_Section):
    """Weights of the terms of the loss."""

    nll: float = Field(1.0, ge=0, description="Laplace likelihood of log depth with its uncertainty")
    scale_invariant: float = Field(1.0, ge=0, description="variance-reduced squared log error")
    scale_invariant_lambda: float = Field(0.5, ge=0, le=1)
    gradient: float = Field(0.5, ge=0, description="multi-scale gradients of the log error")


class SearchRange(_Section):
    """Where ``--search`` looks for one setting: between ``low`` and ``high``, or among ``choices``."""

    low: float | None = None
    high: float | None = None
    log: bool = Field(False, description="spread evenly over magnitudes")
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
    """One training run."""

    seed: int = Field(0, ge=0)
    members: int = Field(1, ge=1, le=16, description="heads trained from different seeds and averaged")
    coarse_epochs: int = Field(10, ge=0, description="epochs judged at 1/7 resolution, before the upsampling")
    fine_epochs: int = Field(
        1, ge=0, description="epochs at full resolution, after them, that train the upsampling alone"
    )
    batch: int = Field(16, ge=1)
    learning_rate: float = Field(
        2e-3, gt=0, description="peak, in the coarse epochs and again in the fine ones"
    )
    weight_decay: float = Field(0.05, ge=0)
    uncertainty: Literal["own", "out_of_fold"] = Field(
        "own", description="each member's own, or that together with what errors in places left out teach"
    )
    sigma_scale: float = Field(
        1.0, gt=0,
        description="calibration of sigma; measured instead where there are held-out places or out_of_fold",
    )  # fmt: skip
    backbone: str | None = Field(None, description="weights file; the cached one if absent")
    trained_on: str = Field("", description="said of the head wherever it is used; its places if empty")
    licence: str = Field("unknown", description="licence of the head")
    output: str = Field(description="file the head is written to")
    sources: tuple[SourceConfig, ...] = Field(min_length=1)
    view: ViewConfig = ViewConfig()
    head: HeadConfig = HeadConfig()
    loss: LossConfig = LossConfig()
    search: dict[str, SearchRange] = Field(
        {}, description="settings that --search tunes, by their dotted name, such as head.dim"
    )

    @field_validator("fine_epochs")
    @classmethod
    def _trains_at_all(cls, fine_epochs: int, info: ValidationInfo) -> int:
        if fine_epochs == 0 and info.data.get("coarse_epochs") == 0:
            raise ValueError("there must be an epoch at least, and coarse_epochs is 0 too")
        return fine_epochs

    @field_validator("head")
    @classmethod
    def _knows_gravity(cls, head: HeadConfig, info: ValidationInfo) -> HeadConfig:
        view = info.data.get("view")
        if (head.gravity or head.down_dim) and view is not None and not view.upright:
            raise ValueError("gravity and down_dim need 'view: {upright: true}', which finds gravity out")
        return head

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
                    raise ValueError(f"'{source.folder}' is to teach member {member}, and {there_are}")
        return sources

    @classmethod
    def from_yaml(cls, path: str | Path) -> TrainConfig:
        """Read and validate ``path``.

        Raises:
            ConfigError: the file cannot be read, or a setting is unknown, missing or out
                of range; names it.
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
            ConfigError: a setting is unknown, missing or out of range; names it.
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


# What decides on the features, the places or the size of the file is not for a search.
SEARCHABLE: dict[str, bool] = {
    **_numbers(TrainConfig, left_out=("seed", "members", "sigma_scale")),
    **_numbers(HeadConfig, "head.", left_out=("down_dim",)),
    **_numbers(LossConfig, "loss."),
}
"""Settings that can be searched, by dotted name; True where they are whole numbers."""


def digest(section: BaseModel, *more: object) -> str:
    """Short hash of settings (and more), which names caches and checkpoints made with them."""
    text = json.dumps([section.model_dump(mode="json"), [str(item) for item in more]], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:12]
