# SPDX-License-Identifier: Apache-2.0
"""A fitted depth scale as a small YAML file that names its model, weights and sequence."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import yaml

from slamdepth.depth.base import DepthModel
from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit
from slamdepth.errors import ConfigError
from slamdepth.io import write_text
from slamdepth.types import DepthKind, WeightsInfo

FORMAT = "slamdepth depth scale 1"

_MEANING = {
    ScaleDomain.DEPTH: "depth in metres = scale * prediction + shift (in m)",
    ScaleDomain.INVERSE_DEPTH: "1 / depth in metres = scale * prediction + shift (in 1/m)",
}


def write_scale(path: str | Path, fit: ScaleFit) -> None:
    """Write ``fit`` as YAML, for :func:`read_scale`.

    Raises:
        OutputError: ``path`` cannot be written.
    """
    values = {
        "format": FORMAT,
        "sequence": fit.sequence,
        "sequence_id": fit.sequence_id,
        "depth_model": fit.model,
        "kind": fit.kind.value,
        "weights": [vars(info) for info in fit.weights],
        "domain": fit.scale.domain.value,
        "scale": fit.scale.scale,
        "scale_sigma_log": fit.scale_sigma_log,
        "shift": fit.scale.shift,
        "shift_sigma": fit.shift_sigma,
        "frames": fit.frames,
        "pixels": fit.pixels,
        "frame_spread_log": fit.frame_spread_log,
    }
    head = (
        "# The scale of predicted depth, fitted to a sequence's depth sensor by 'slamdepth scale'.\n"
        f"# {_MEANING[fit.scale.domain]}\n"
        "# scale_sigma_log: standard error of the natural log of the scale (with a shift: of the log of the\n"
        "# median depth), by a bootstrap over blocks of frames; it holds for this sequence only.\n"
        "# frame_spread_log: standard deviation over frames of the natural log of each frame's own factor.\n"
        "# Apply it: slamdepth run SEQ --depth-scale THIS_FILE, with the same model and weights.\n"
    )
    write_text(path, head + yaml.safe_dump(values, sort_keys=False))


def read_scale(path: str | Path) -> ScaleFit:
    """Read a file that :func:`write_scale` wrote.

    Raises:
        ConfigError: the file is missing or of another kind, or an entry is missing, unknown or malformed;
            names it.
    """
    path = Path(path).expanduser()
    try:
        values = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot read the depth scale: {error.strerror or error}; give a number, a file of "
            "'slamdepth scale', or groundtruth"
        ) from error
    except (yaml.YAMLError, ValueError) as error:
        raise ConfigError(f"{path}: not valid YAML: {str(error).splitlines()[0]}") from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise ConfigError(f"{path}: not a depth scale; make one with 'slamdepth scale SEQ --output FILE'")
    return _parsed(values, str(path))


def check_same_model(fit: ScaleFit, model: DepthModel, origin: str) -> None:
    """Check that a scale was fitted to the predictions of ``model``.

    Args:
        fit: the scale.
        model: that it is to be applied to.
        origin: of the scale, named in errors.

    Raises:
        ConfigError: model or weights differ; names the difference.
    """
    if (fit.model, fit.kind) != (model.name, model.kind):
        raise ConfigError(
            f"{origin}: is the scale of '{fit.model}' ({fit.kind.value}), "
            f"this run uses '{model.name}' ({model.kind.value})"
        )
    theirs, ours = ([info.sha256 for info in weights] for weights in (fit.weights, model.weights))
    if theirs != ours:
        differ = next((w for w in model.weights if w.sha256 not in theirs), None)
        raise ConfigError(
            f"{origin}: was fitted with other weights of '{model.name}' than this run uses"
            + (f" ({differ.name}, sha256 {differ.sha256[:12]}...)" if differ else "")
            + "; fit it again with 'slamdepth scale'"
        )


def _parsed(values: dict[str, Any], origin: str) -> ScaleFit:
    rest = dict(values)
    try:
        del rest["format"]
        fit = ScaleFit(
            scale=DepthScale(
                _number(rest, "scale", above=0.0), _number(rest, "shift"), ScaleDomain(rest.pop("domain"))
            ),
            sequence=str(rest.pop("sequence")),
            model=str(rest.pop("depth_model")),
            kind=DepthKind(rest.pop("kind")),
            weights=tuple(
                WeightsInfo(**{str(k): str(v) for k, v in info.items()}) for info in rest.pop("weights")
            ),
            scale_sigma_log=_optional(rest, "scale_sigma_log"),
            shift_sigma=_optional(rest, "shift_sigma"),
            frames=int(_number(rest, "frames", above=0.0)),
            pixels=int(_number(rest, "pixels", above=0.0)),
            frame_spread_log=_number(rest, "frame_spread_log"),
            sequence_id=str(rest.pop("sequence_id", "")),
        )
    except KeyError as error:
        raise ConfigError(f"{origin}: the entry {error} is missing") from error
    except (TypeError, ValueError, AttributeError) as error:
        raise ConfigError(f"{origin}: {error}") from error
    if rest:
        raise ConfigError(f"{origin}: unknown entry {next(iter(rest))!r}")
    if fit.scale.domain is not ScaleDomain.of(fit.kind):
        raise ConfigError(f"{origin}: {fit.kind.value} is not scaled as {fit.scale.domain.value}")
    return fit


def _number(values: dict[str, Any], key: str, above: float = -math.inf) -> float:
    value = values.pop(key)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{key} must be a number, got {value!r}")
    if not (math.isfinite(value) and value > above):
        raise ValueError(f"{key} is out of range: {value}")
    return float(value)


def _optional(values: dict[str, Any], key: str) -> float | None:
    return None if values.get(key, 0) is None and values.pop(key) is None else _number(values, key)
