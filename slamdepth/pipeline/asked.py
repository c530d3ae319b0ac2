# SPDX-License-Identifier: Apache-2.0
"""What a run was asked for: as a command, as settings, for its report, and to do it again."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

from slamdepth.config import Config
from slamdepth.datasets import ReadOptions
from slamdepth.datasets.addresses import without_secret
from slamdepth.pipeline.folder import as_argument
from slamdepth.pipeline.options import (
    RunOptions,
)
from slamdepth.pipeline.tracking import Tracked


def reported_options(options: RunOptions, tracked: Tracked) -> dict[str, object]:
    """The options without paths: a report is passed on, folders of a machine are not."""
    asked = asdict(options)
    for name in ("sequence", "output", "overwrite", "camera_file", "start_map", "checkpoint_s"):
        asked.pop(name)
    usual = asdict(ReadOptions())
    reading = {name: value for name, value in asked.pop("reading").items() if value != usual[name]}
    asked |= {"reading": reading} if reading else {}
    return {
        **asked,
        "camera_file": options.camera_file is not None,
        "start_map": options.start_map is not None,
        "interrupted": tracked.interrupted,
    }


def arguments_of(options: RunOptions) -> list[str]:
    """What the command line was given, without the settings and the run folder."""
    arguments = [as_argument(without_secret(str(options.sequence)))]
    if options.camera_file is not None:
        arguments += ["--camera", str(options.camera_file)]
    if options.view_deg is not None:
        arguments += ["--fov", f"{options.view_deg:g}"]
    if options.max_frames is not None:
        arguments += ["--max-frames", str(options.max_frames)]
    if options.stride != 1:
        arguments += ["--stride", str(options.stride)]
    if options.exports:
        arguments += ["--export", ",".join(options.exports)]
    if options.start_map is not None:
        arguments += ["--map", str(options.start_map)]
    if options.map_images:
        arguments.append("--map-images")
    arguments += options.reading.arguments()
    return arguments if options.mesh else [*arguments, "--no-mesh"]


def settings_text(options: RunOptions, config: Config) -> str:
    camera = "none" if options.camera_file is None else Path(options.camera_file).name
    lines = [
        "# The settings of this run; 'slamdepth run SEQ --config' reads them back. These are not read back:",
        f"# sequence: {Path(without_secret(str(options.sequence))).name}, --camera: {camera}",
        f"# stride: {options.stride}, max frames: {options.max_frames}, mesh: {options.mesh}",
        "# For the same run again, give them again; README.txt has the command.",
    ]
    return "\n".join(lines) + "\n" + config.to_yaml()


def begun_run(options: RunOptions, config: Config, about: dict[str, Any]) -> dict[str, Any]:
    """What it takes to do a run again, from whatever folder."""
    asked = asdict(options)
    paths = ("sequence", "camera_file", "start_map")
    return {
        "options": {
            **{name: value for name, value in asked.items() if name not in (*paths, "output", "overwrite")},
            **{
                name: None if asked[name] is None else str(Path(asked[name]).expanduser().absolute())
                for name in paths
            },
        },
        "config": config.to_dict(),
        "sequence": about,
    }
