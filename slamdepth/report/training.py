# SPDX-License-Identifier: Apache-2.0
"""Report of a training: loss curves, sample predictions and the figures of every epoch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import OutputError
from slamdepth.io import write_json, write_text
from slamdepth.report.environment import hardware, versions
from slamdepth.report.figure import new_figure, write_png
from slamdepth.report.keyframe_images import colour_depth, near_to_far

if TYPE_CHECKING:
    from slamdepth.training.results import EpochFigures, SampleView, TrainResult

_COLOURS = ("#17458f", "#c8502b", "#2f9e4f", "#8a4fb0", "#b58a00", "#11787f")
_README = """Report of the training of a depth head.

losses.png     loss by epoch, one colour per member: solid on the training views, dashed on the
               held-out places. The loss is at 1/7 resolution left of the grey line and at full
               resolution right of it; the two are not comparable. Training views are augmented
               and seen with dropout, held-out ones are not, so their loss can be lower. Below:
               AbsRel on the held-out places after median scaling per view.
samples.png    views as seen by the network, sensor depth, depth predicted by the finished head and
               its uncertainty (standard deviation of log depth, so 0.1 is about 10 %). Depth is
               dark blue near, green, yellow far, and grey where unknown; sensor and prediction in a
               row share one scale.
history.json   all figures, places, settings, versions and hardware.

The head is {output}; its header holds the settings too.
"""


def write_training_report(folder: Path, result: TrainResult, settings: dict[str, Any]) -> None:
    """Write ``losses.png``, ``samples.png``, ``history.json`` and ``README.txt`` into ``folder``.

    Raises:
        OutputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be made: {error.strerror or error}") from error
    write_json(
        folder / "history.json",
        {
            "output": result.output.name,
            "trained_on": result.about["trained_on"],
            "sigma_scale": result.sigma_scale,
            "held_out": result.held_out,
            "unseen_surest_half": result.unseen_surest_half,
            "places": result.places,
            "epochs": [asdict(figures) for figures in result.history],
            "backbone_sha256": result.about["backbone_sha256"],
            "settings": settings,
            "versions": versions(),
            "hardware": hardware(),
        },
    )
    if result.history:
        draw_losses(folder / "losses.png", result)
    if result.samples:
        draw_samples(folder / "samples.png", result.samples)
    write_text(folder / "README.txt", _README.format(output=result.output.name))


def draw_losses(path: Path, result: TrainResult) -> None:
    """Plot the loss, and the AbsRel of held-out places if there are any, over epochs; a colour per member."""
    history = result.history
    is_judged = any(figures.held_out_loss is not None for figures in history)
    figure, axes = new_figure(9.0, 6.4 if is_judged else 3.8, 2 if is_judged else 1, 1, sharex=True)
    panels = axes[:, 0]
    for member in sorted({figures.member for figures in history}):
        _draw_member(panels, [figures for figures in history if figures.member == member])
    fine = [figures.epoch for figures in history if figures.is_fine]
    for panel in panels:
        panel.grid(True, color="#dddddd", lw=0.6)
        panel.spines[["top", "right"]].set_visible(False)
        if fine and min(fine) > 0:
            panel.axvline(min(fine) + 0.5, color="#999999", lw=1.0)
    last = max(figures.epoch for figures in history) + 1
    panels[0].set(ylabel="loss", title="Loss by epoch")
    panels[0].legend(frameon=False, ncols=2, fontsize=8)
    if is_judged:
        places = ", ".join(result.held_out)
        title = f"Held out ({places}): AbsRel after median scaling per view"
        panels[1].set(ylabel="AbsRel", ylim=(0, None), title=title)
    panels[-1].set(xlabel="epoch", xlim=(0.5, last + 0.5))
    panels[-1].xaxis.get_major_locator().set_params(integer=True)
    write_png(figure, path)


def _draw_member(panels: Sequence[Any], history: Sequence[EpochFigures]) -> None:
    """Draw the curves of one member: loss in the first panel, AbsRel in the second if there is one."""
    member = history[0].member
    colour, name = _COLOURS[member % len(_COLOURS)], f"member {member + 1}"
    for is_fine in (False, True):
        stage = [figures for figures in history if figures.is_fine is is_fine]
        if not stage:
            continue
        epochs = [figures.epoch + 1 for figures in stage]
        label = name if stage[0] is history[0] else None
        panels[0].plot(epochs, [f.loss for f in stage], "o-", color=colour, ms=3, label=label)
        if len(panels) > 1:
            losses = [np.nan if f.held_out_loss is None else f.held_out_loss for f in stage]
            label = f"{name}, held out" if label else None
            panels[0].plot(epochs, losses, "s--", color=colour, ms=3, label=label)
            errors = [np.nan if f.held_out_abs_rel is None else f.held_out_abs_rel for f in stage]
            panels[1].plot(epochs, errors, "s--", color=colour, ms=3)


def draw_samples(path: Path, samples: tuple[SampleView, ...]) -> None:
    """Plot one row per sample: image, sensor depth, prediction, standard deviation of its log."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    rows, columns = samples[0].image_rgb.shape[:2]
    width = 11.5
    figure, axes = new_figure(
        width, 0.4 + len(samples) * (0.195 * width * rows / columns + 0.2), len(samples), 4
    )
    depth_colours = near_to_far()
    lowest, highest = np.percentile(np.concatenate([s.sigma_log.ravel() for s in samples]), (2, 98))
    for row, sample in zip(axes, samples, strict=True):
        known = sample.sensor_m[sample.sensor_m > 0]
        both = np.concatenate([known, sample.predicted_m.ravel()])
        near_m, far_m = (float(v) for v in np.percentile(both, (1, 98)))
        row[0].imshow(sample.image_rgb)
        row[1].imshow(colour_depth(sample.sensor_m, near_m, far_m), interpolation="nearest")
        row[2].imshow(colour_depth(sample.predicted_m, near_m, far_m), interpolation="nearest")
        uncertainty = row[3].imshow(
            sample.sigma_log, cmap="magma", vmin=lowest, vmax=highest, interpolation="nearest"
        )
        scale = ScalarMappable(Normalize(near_m, far_m), depth_colours)
        figure.colorbar(scale, ax=row[2], shrink=0.85, label="m")
        figure.colorbar(uncertainty, ax=row[3], shrink=0.85)
        row[0].set_ylabel(f"{sample.place}\n{'held out' if sample.is_held_out else 'trained on'}", fontsize=8)
        for panel in row:
            panel.set(xticks=[], yticks=[])
    titles = ("image", "sensor depth", "predicted depth", "deviation of log depth")
    for panel, title in zip(axes[0], titles, strict=True):
        panel.set_title(title, fontsize=10)
    write_png(figure, path)
