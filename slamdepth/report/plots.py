# SPDX-License-Identifier: Apache-2.0
"""The plots of a report: each an inline SVG, or None where its data are missing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from slamdepth.geometry import invert, transform
from slamdepth.report import figure as fig
from slamdepth.report.axes import drawing_views
from slamdepth.report.gaps import gap_ends, with_gaps
from slamdepth.types import TrackingStatus
from slamdepth.typing import Floats

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from slamdepth.evaluation import RelativeError, TrajectoryScore
    from slamdepth.mapping.keyframe import Keyframe
    from slamdepth.mapping.reconstruction import Reconstruction
    from slamdepth.types import StepResult


_WIDTH = 9.6
_MAX_MAP_POINTS = 20_000
_CLOUD = "#8391a7"


_STATUS_COLOURS = {
    TrackingStatus.INITIALISING: fig.MUTED,
    TrackingStatus.TRACKING: fig.GOOD,
    TrackingStatus.RELOCALISED: fig.ESTIMATE,
    TrackingStatus.REGISTERED: fig.WARN,
    TrackingStatus.LOST: fig.BAD,
}


def trajectory_plot(run: Reconstruction, score: TrajectoryScore | None) -> str | None:
    """The path from above and from the side, see :func:`drawing_views`."""
    if len(run.trajectory) == 0:
        return None
    path = run.trajectory.T_world_camera[:, :3, 3]
    lines = [(with_gaps(run.trajectory.timestamps_s, path), fig.ESTIMATE, "-", "estimate")]
    links: Floats | None = None
    if score is not None:
        T_estimate_truth = invert(score.se3.T_truth_estimate)
        truth = transform(T_estimate_truth, score.truth_m)
        lines.insert(0, (with_gaps(score.timestamps_s, truth), fig.TRUTH, "-", "ground truth"))
        if abs(score.sim3.scale - 1) > 0.02:
            scaled = transform(T_estimate_truth @ score.sim3.T_truth_estimate, score.estimate_m)
            label = f"estimate × {score.sim3.scale:.3f}"
            lines.append((with_gaps(score.timestamps_s, scaled), fig.SCALED, "--", label))
        step = max(1, score.matched // 150)
        ends = np.stack([truth, score.estimate_m, np.full_like(truth, np.nan)], axis=1)[::step]
        links = ends.reshape(-1, 3)

    views = drawing_views(run.gravity_w)
    with fig.styled("trajectory"):
        figure, axes = fig.new_figure(_WIDTH, 4.6, 1, 2)
        for panel, view in zip(axes[0], views, strict=True):
            if links is not None:
                panel.plot(*view.flat(links).T, color=fig.MUTED, lw=0.5, alpha=0.6)
            for positions, colour, style, label in lines:
                panel.plot(*view.flat(positions).T, style, color=colour, label=label)
            panel.plot(*view.flat(path[:1]).T, "o", color=fig.INK, ms=4, label="start")
            view.frame(panel, view.flat(np.concatenate([line[0] for line in lines])))
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels))
        return fig.to_svg(figure, f"Trajectory: {views[0].title}, {views[1].title}")


def map_plot(run: Reconstruction) -> str | None:
    """The sparse map from above and from the side, see :func:`drawing_views`, with the path through it."""
    cloud = run.points_m[np.isfinite(run.points_m).all(axis=1)]
    if len(cloud) == 0 or len(run.trajectory) == 0:
        return None
    cloud = cloud[:: -(-len(cloud) // _MAX_MAP_POINTS)]
    low, high = np.percentile(cloud, (1, 99), axis=0)
    near = cloud[np.all((cloud >= low) & (cloud <= high), axis=1)]
    path = run.trajectory.T_world_camera[:, :3, 3]
    broken = with_gaps(run.trajectory.timestamps_s, path)
    positions = np.array([keyframe.T_world_camera[:3, 3] for keyframe in run.keyframes]).reshape(-1, 3)
    views = drawing_views(run.gravity_w)
    with fig.styled("map"):
        figure, axes = fig.new_figure(_WIDTH, 4.4, 1, 2)
        for panel, view in zip(axes[0], views, strict=True):
            panel.plot(*view.flat(cloud).T, ".", color=_CLOUD, ms=2.2, alpha=0.6, mew=0, rasterized=True)
            panel.plot(*view.flat(broken).T, color=fig.ESTIMATE)
            panel.plot(*view.flat(positions).T, "o", color=fig.ESTIMATE, ms=2.2)
            view.frame(panel, view.flat(np.concatenate([near, path])))
        return fig.to_svg(figure, f"Sparse map: {views[0].title}, {views[1].title}")


def tracking_plot(steps: tuple[StepResult, ...]) -> str | None:
    """State of each frame as a strip, keyframes as ticks, and the inliers of each pose."""
    if not steps:
        return None
    from matplotlib.patches import Patch

    times = np.array([step.timestamp_s for step in steps]) - steps[0].timestamp_s
    edges = np.append(times, times[-1] + (np.median(np.diff(times)) if len(times) > 1 else 1.0))
    seen = [status for status in TrackingStatus if any(step.status == status for step in steps)]
    with fig.styled("tracking"):
        figure, axes = fig.new_figure(_WIDTH, 2.7, 2, 1, sharex=True, height_ratios=(1, 3.2))
        strip, inliers = axes[:, 0]
        for status in seen:
            runs = _runs(np.array([step.status == status for step in steps]))
            bars = [(edges[first], edges[last] - edges[first]) for first, last in runs]
            strip.broken_barh(bars, (0.3, 0.7), color=_STATUS_COLOURS[status], lw=0)
        keyframes = [time for time, step in zip(times, steps, strict=True) if step.is_keyframe]
        strip.vlines(keyframes, 0.0, 0.22, color=fig.INK, lw=0.7)
        strip.set(ylim=(0, 1), yticks=[], xlim=(0, edges[-1]))
        strip.grid(False)
        strip.spines[["left", "bottom"]].set_visible(False)
        strip.tick_params(axis="x", length=0)
        handles = [Patch(color=_STATUS_COLOURS[status], label=status.value) for status in seen]
        keyframe = strip.vlines([], 0, 0, color=fig.INK, lw=0.9, label=f"{len(keyframes)} keyframes")
        fig.legend_above(strip, columns=6, handles=[*handles, keyframe])
        values = np.array([step.inliers for step in steps], dtype=float)
        inliers.fill_between(times, values, color=fig.ESTIMATE, alpha=0.18, lw=0)
        inliers.plot(times, values, color=fig.ESTIMATE, lw=1.0)
        inliers.set(ylim=(0, None), xlabel="time (s)", ylabel="inliers")
        return fig.to_svg(figure, "Tracking state, keyframes and inliers over time")


def ate_plot(score: TrajectoryScore | None) -> str | None:
    """Distance of each pose from the ground truth after alignment."""
    if score is None:
        return None
    times = score.timestamps_s - score.timestamps_s[0]
    with fig.styled("ate"):
        figure, axes = fig.new_figure(_WIDTH, 2.6)
        panel = axes[0, 0]
        for error, colour, name in ((score.se3, fig.ESTIMATE, "SE(3)"), (score.sim3, fig.SCALED, "Sim(3)")):
            values = with_gaps(score.timestamps_s, 100 * error.errors_m[:, None])
            label = f"{name}, RMSE {100 * error.rmse_m:.2f} cm"
            panel.plot(_gap_times(score.timestamps_s), values[:, 0], color=colour, label=label)
            panel.axhline(100 * error.rmse_m, color=colour, lw=0.8, ls=":")
        panel.set(xlabel="time (s)", ylabel="position error (cm)", ylim=(0, None), xlim=(0, times[-1]))
        fig.legend_above(panel)
        return fig.to_svg(figure, "Absolute trajectory error over time")


def rpe_plot(score: TrajectoryScore | None) -> str | None:
    """Drift over a second (or from frame to frame in a shorter run) over time."""
    if score is None:
        return None
    error: RelativeError = score.per_second or score.per_frame
    span = "a second" if score.per_second else "a frame"
    times = score.timestamps_s[error.end_indices]
    with fig.styled("rpe"):
        figure, axes = fig.new_figure(_WIDTH, 2.6, 1, 2)
        panels = (
            (axes[0, 0], "translation", 100 * error.trans_errors_m, 100 * error.trans_rmse_m, "cm"),
            (axes[0, 1], "rotation", error.rot_errors_deg, error.rot_rmse_deg, "°"),
        )
        for panel, name, values, rmse, unit in panels:
            x = _gap_times(times, score.timestamps_s[0])
            panel.plot(x, with_gaps(times, values[:, None])[:, 0], color=fig.ESTIMATE)
            panel.axhline(rmse, color=fig.ESTIMATE, lw=0.8, ls=":", label=f"RMSE {rmse:.2f} {unit}")
            panel.set(xlabel="time (s)", ylabel=f"error ({unit})", ylim=(0, None), title=f"{name} in {span}")
            fig.legend_above(panel)
        return fig.to_svg(figure, "Relative pose error over time")


def position_plot(run: Reconstruction, score: TrajectoryScore | None) -> str | None:
    """Each coordinate over time in the frame of the first camera."""
    if len(run.trajectory) < 2:
        return None
    names = ("x right", "y down", "z forward")
    start_s = run.trajectory.timestamps_s[0]
    path = run.trajectory.T_world_camera[:, :3, 3]
    series = [(run.trajectory.timestamps_s, path, fig.ESTIMATE, "estimate")]
    if score is not None:
        truth = transform(invert(score.se3.T_truth_estimate), score.truth_m)
        series.insert(0, (score.timestamps_s, truth, fig.TRUTH, "ground truth"))
    with fig.styled("position"):
        figure, axes = fig.new_figure(_WIDTH, 3.9, 3, 1, sharex=True)
        for axis, (panel, name) in enumerate(zip(axes[:, 0], names, strict=True)):
            for times, positions, colour, label in series:
                values = with_gaps(times, positions)
                panel.plot(_gap_times(times, start_s), values[:, axis], color=colour, label=label)
            panel.set_ylabel(f"{name} (m)")
        fig.legend_above(axes[0, 0])
        axes[2, 0].set(xlabel="time (s)", xlim=(0, run.trajectory.timestamps_s[-1] - start_s))
        return fig.to_svg(figure, "Position of the camera over time")


def scale_plot(keyframes: tuple[Keyframe, ...]) -> str | None:
    """The factor that turned each keyframe's predicted depth into metres of the map, over time."""
    scales = np.array([keyframe.depth_scale for keyframe in keyframes if not keyframe.prediction.is_sensor])
    times = [k.frame.timestamp_s for k in keyframes if not k.prediction.is_sensor]
    good = np.isfinite(scales) & (scales > 0)
    if good.sum() < 2:
        return None
    with fig.styled("scale"):
        figure, axes = fig.new_figure(_WIDTH, 2.2)
        panel = axes[0, 0]
        seconds = (np.array(times) - times[0])[good]
        panel.axhline(1.0, color=fig.MUTED, lw=0.8, ls=":")
        panel.plot(seconds, scales[good], "o-", color=fig.ESTIMATE, ms=3)
        panel.set(xlabel="time (s)", ylabel="factor on the depth")
        return fig.to_svg(figure, "Factor applied to the predicted depth of each keyframe")


def _gap_times(times: Floats, start_s: float | None = None) -> Floats:
    """Seconds since ``start_s`` (default: the first time) for the rows of :func:`_with_gaps`."""
    seconds = times - (times[0] if start_s is None else start_s)
    return np.insert(seconds, gap_ends(times), np.nan)


def _runs(flags: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """``(first, past the last)`` of each unbroken run of True."""
    changes = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(changes[::2], changes[1::2], strict=True)]
