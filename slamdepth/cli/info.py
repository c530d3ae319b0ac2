# SPDX-License-Identifier: Apache-2.0
"""``slamdepth info``: what an input is, and what is wrong with it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, show_log
from slamdepth.cli.options import (
    CameraOption,
    DepthTopicOption,
    FollowLinksOption,
    PoseTopicOption,
    TopicOption,
)

if TYPE_CHECKING:
    from slamdepth.datasets.summary import SequenceSummary


def info_command(
    sequence: Annotated[
        Path, typer.Argument(metavar="INPUT", help="A video, folder, bag or live source; see docs/inputs.md.")
    ],
    camera: CameraOption = None,
    topic: TopicOption = None,
    depth_topic: DepthTopicOption = None,
    pose_topic: PoseTopicOption = None,
    follow_links: FollowLinksOption = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Tell what an input is: length, rate, size, intrinsics and where they came from, and what is wrong.

    Example: slamdepth info walk.mp4

    Example: slamdepth info recording.bag --topic /camera/color/image_raw --json
    """
    show_log()
    from slamdepth.datasets import ReadOptions, open_dataset
    from slamdepth.datasets.summary import summarise

    options = ReadOptions(topic, depth_topic, pose_topic, follow_links)
    dataset = open_dataset(sequence, camera, options)
    try:
        summary = summarise(dataset)
    finally:
        dataset.close()
    if as_json:
        from slamdepth.io.text import json_text

        typer.echo(json_text(summary.to_dict()), nl=False)
        return
    _print(summary, quiet)


def _print(summary: SequenceSummary, quiet: bool) -> None:
    out = console()
    lines = _lines(summary.facts)
    width = max(map(len, lines))
    for name, value in lines.items():
        out.print(f"{name:<{width}}  {value}", markup=False, soft_wrap=True)
    for problem in summary.problems:
        out.print(f"problem: {problem}", style="red", markup=False, soft_wrap=True)
    if not quiet:
        print_notes(out, summary.notes)


def _lines(facts: dict[str, Any]) -> dict[str, str]:
    lens = facts["intrinsics"]
    intrinsics = ", ".join(f"{name} {value:.2f}" for name, value in lens.items())
    if any(facts["distortion"]):
        coefficients = ", ".join(f"{value:.4g}" for value in facts["distortion"])
        intrinsics += f"; distortion {coefficients}"
    rate = "unknown" if facts["rate_hz"] is None else f"{facts['rate_hz']:.2f} Hz"
    if facts["live"]:
        length = f"live, {rate}"
    else:
        seconds = facts["duration_s"] or 0.0
        length = f"{facts['frames']} frames in {seconds:.2f} s, {rate}"
    truth, depth = facts["ground_truth"], facts["depth"]
    return {
        "input": facts["path"],
        "layout": facts["layout"],
        "length": length,
        "size": f"{facts['width']}x{facts['height']} pixels",
        "intrinsics": intrinsics,
        "from": f"{facts['camera_source']} ({facts['camera_certainty']})",
        "ground truth": "none" if truth is None else _truth(truth),
        "depth": "none" if depth is None else _depth(depth),
        "inertial data": "none" if facts["imu"] is None else f"{facts['imu']} (use it: --imu {facts['imu']})",
    }


def _truth(truth: dict[str, Any]) -> str:
    unit = "m" if truth["metric"] else "units"
    return f"{truth['poses']} poses over {truth['path_length']:.2f} {unit}; {truth['source']}"


def _depth(depth: dict[str, Any]) -> str:
    if depth["median_m"] is None:
        return "unknown everywhere"
    return f"median {depth['median_m']:.2f} m, known in {100 * depth['share_known']:.0f} % of the pixels"
