# SPDX-License-Identifier: Apache-2.0
"""A sheet of images: a few frames, their sensor depth, and what each model predicts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.depth_judged import kept_predictions
from slamdepth.report.figure import new_figure, write_png
from slamdepth.report.keyframe_images import colour_depth
from slamdepth.training.data import Place
from slamdepth.types import Frame
from slamdepth.typing import Floats


def draw_kept(output: Path, judged: Sequence[Place], files: Mapping[str, Sequence[Path]]) -> None:
    """Draw the predictions that were kept of each data set into ``output / NAME.png``.

    Args:
        judged: the data sets.
        files: of each model, the one of each data set that
            :func:`~benchmarks.depth_judged.judged_row` wrote.

    Raises:
        OutputError: a file cannot be written.
    """
    for number, place in enumerate(judged):
        kept = {name: kept_predictions(of_model[number]) for name, of_model in files.items()}
        indices = sorted(set.intersection(*(set(found) for found in kept.values())))
        if indices:
            title = f"{place.name}: predictions scaled by the median of each frame"
            write_pictures(output / f"{place.name}.png", [place.read(k) for k in indices], kept, title)


def write_pictures(
    path: Path, frames: Sequence[Frame], predictions: Mapping[str, Mapping[int, Floats]], title: str
) -> None:
    """Write the frames as rows and image, sensor and models as columns, as PNG.

    The colours of a row go from the 1st to the 99th percentile of its sensor depth.

    Args:
        frames: with depth.
        predictions: of each model, metres ``(H, W)`` by the index of the frame.

    Raises:
        OutputError: the file cannot be written.
    """
    columns = 2 + len(predictions)
    figure, axes = new_figure(1.75 * columns, 1.4 * len(frames) + 0.6, len(frames), columns)
    for line, frame in zip(axes, frames, strict=True):
        assert frame.depth_m is not None
        near_m, far_m = np.percentile(frame.depth_m[frame.depth_m > 0], (1, 99)).tolist()
        shown = [frame.image_rgb, colour_depth(frame.depth_m, near_m, far_m)]
        shown += [colour_depth(found[frame.index], near_m, far_m) for found in predictions.values()]
        for axis, image in zip(line, shown, strict=True):
            axis.imshow(image, interpolation="nearest")
            axis.set(xticks=[], yticks=[])
    for axis, name in zip(axes[0], ("image", "sensor", *predictions), strict=True):
        axis.set_title(name, fontsize=8)
    figure.suptitle(title, fontsize=9)
    write_png(figure, path)
