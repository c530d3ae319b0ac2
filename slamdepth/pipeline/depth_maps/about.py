# SPDX-License-Identifier: Apache-2.0
"""The content of ``depth.json`` and the README of a folder of depth maps: model, unit, intrinsics, notes."""

from __future__ import annotations

import re
from typing import Any

from slamdepth._version import __version__
from slamdepth.datasets.intrinsics import Certainty, Intrinsics
from slamdepth.depth.base import DepthModel, is_sensor
from slamdepth.depth.card import card_of
from slamdepth.pipeline.depth_maps.folder import readme_head
from slamdepth.pipeline.depth_maps.sources import Source
from slamdepth.types import DepthKind

METRES, NO_UNIT = "metres", "relative, no unit"


def images(number: int) -> str:
    """``number`` with its noun."""
    return "1 image" if number == 1 else f"{number} images"


def public_name(model: DepthModel) -> str:
    """The model's name without folders of this machine, since results are passed on."""
    return re.sub(r"onnx:.*/", "onnx:", model.name)


def intrinsics_entry(intrinsics: Intrinsics) -> dict[str, Any]:
    """The camera of a frame as the journal keeps it, in pixels."""
    camera = intrinsics.camera
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": list(camera.distortion),
        "intrinsics": intrinsics.how,
        "certainty": intrinsics.certainty.value,
    }


def about_folder(
    source: Source,
    model: DepthModel,
    frames: list[dict[str, Any]],
    skipped: list[dict[str, str]],
    settings: dict[str, Any],
) -> dict[str, Any]:
    """The content of ``depth.json``.

    Args:
        frames: the journal's entries of the images that are done, in order.
        skipped: origin and reason of those that were left out.
        settings: what a later call must have in common.
    """
    is_metric = model.kind is DepthKind.METRIC
    card = card_of(model)
    return {
        "slamdepth": __version__,
        "source": {"kind": source.kind.value, "name": source.name, "frames_per_second": source.fps},
        "model": {
            "name": public_name(model),
            "kind": model.kind.value,
            "native_size": None if card is None else list(card.native_size),
            "native_focal_px": None if card is None else card.native_focal_px,
            "weights": [
                {
                    "name": w.name,
                    "sha256": w.sha256,
                    "trained_on": w.trained_on,
                    "licence": w.licence,
                    "precision": w.precision,
                }
                for w in model.weights
            ],
        },
        "unit": METRES if is_metric else NO_UNIT,
        "scale": scale_sentence(model, frames),
        "intrinsics": _intrinsics(frames),
        "frames": len(frames),
        "skipped": skipped,
        "notes": [*source.notes, *_notes(frames, skipped)],
        "settings": settings,
    }


def scale_sentence(model: DepthModel, frames: list[dict[str, Any]]) -> str:
    """How far the numbers of the depth maps can be trusted."""
    if model.kind is not DepthKind.METRIC:
        return (
            f"{public_name(model)} predicts {model.kind.value}: known up to a scale and an offset, "
            "which differ from image to image; no number here is a length"
        )
    if is_sensor(model):
        return "metric, measured by the depth sensor"
    guessed = [frame for frame in frames if frame["certainty"] == Certainty.GUESSED.value]
    if guessed:
        which = (
            "the focal length"
            if len(guessed) == len(frames)
            else f"the focal length of {images(len(guessed))}"
        )
        return (
            f"metres rest on a guess: {which} is not known, and distances and the shape of the point "
            "cloud change with it; --camera FILE names the real one"
        )
    return f"metric as far as the prediction of {public_name(model)} is; no sensor measured it"


def readme_text(about: dict[str, Any]) -> list[str]:
    """The head of the README of a finished folder."""
    source, model = about["source"], about["model"]
    lines = [
        readme_head(f"the {source['kind']} {source['name']}: {images(about['frames'])}"),
        "",
        f"model       {model['name']}, {model['kind']}",
        *(f"weights     {w['name']}, sha256 {w['sha256']}" for w in model["weights"]),
        f"unit        {about['unit']}",
        f"scale       {about['scale']}",
        *(f"intrinsics  {images(group['images'])}: {group['how']}" for group in about["intrinsics"]),
    ]
    return [*lines, *(f"note        {note}" for note in about["notes"])]


def _intrinsics(frames: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The different cameras and how they were found, each with its number of images."""
    keys = ("width", "height", "fx", "fy", "cx", "cy", "distortion", "intrinsics", "certainty")
    groups: dict[str, dict[str, Any]] = {}
    for frame in frames:
        camera = {key: frame[key] for key in keys}
        group = groups.setdefault(repr(camera), {"images": 0, **camera, "how": camera["intrinsics"]})
        group["images"] += 1
    for group in groups.values():
        del group["intrinsics"]
    return list(groups.values())


def _notes(frames: list[dict[str, Any]], skipped: list[dict[str, str]]) -> list[str]:
    notes = []
    if skipped:
        first = skipped[0]["reason"]
        notes.append(f"left out: {images(len(skipped))}; the first: {first}")
    beyond = [frame for frame in frames if frame.get("beyond_65535_mm")]
    if beyond:
        pixels = sum(frame["beyond_65535_mm"] for frame in beyond)
        notes.append(
            f"{pixels} pixels of {images(len(beyond))} lie beyond 65.535 m and are 0 in the 16-bit images"
        )
    return notes
