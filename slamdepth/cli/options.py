# SPDX-License-Identifier: Apache-2.0
"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

DepthOption = Annotated[
    str,
    typer.Option(
        "--depth",
        metavar="NAME",
        help="Depth model, hf:ORG/NAME of the hub or hf:FOLDER; an unknown name lists all names. Default: "
        "auto, the best metric model in the cache folder, else dinov2",
        show_default=False,
    ),
]
DepthWeightsOption = Annotated[
    Path | None,
    typer.Option(
        "--depth-weights",
        metavar="FILE",
        help="Weights file (or folder of the hub) of the depth model; for dinov2, of its head.",
    ),
]
CameraOption = Annotated[
    Path | None,
    typer.Option("--camera", metavar="FILE", help="camera.yaml with the intrinsics in pixels."),
]
FovOption = Annotated[
    float | None,
    typer.Option(
        "--fov",
        min=1.0,
        max=170.0,
        metavar="DEG",
        help="Field of view across the longer side of an image, instead of --camera; the focal length is "
        "looked for about it.",
    ),
]
StrideOption = Annotated[int, typer.Option("--stride", min=1, metavar="N", help="Take every Nth frame.")]
MaxFramesOption = Annotated[
    int | None, typer.Option("--max-frames", min=1, metavar="N", help="Take no more than N frames.")
]
DeviceOption = Annotated[
    str, typer.Option("--device", metavar="cpu|cuda|cuda:N", help="Where the network runs.")
]
TopicOption = Annotated[
    str | None,
    typer.Option("--topic", metavar="NAME", help="Image topic of a bag. Default: the likeliest camera"),
]
DepthTopicOption = Annotated[
    str | None,
    typer.Option("--depth-topic", metavar="NAME", help="Depth topic of a bag. Default: the one next to it"),
]
PoseTopicOption = Annotated[
    str | None,
    typer.Option(
        "--pose-topic",
        metavar="NAME",
        help="Topic of a bag to take as ground truth: poses, odometry or /tf. Default: none",
    ),
]
FollowLinksOption = Annotated[
    bool,
    typer.Option("--follow-links", help="Lists and links of the sequence may lead out of its folder."),
]
SecondsOption = Annotated[
    float | None,
    typer.Option("--seconds", metavar="S", help="Read no more than S seconds of the recording."),
]
PortOption = Annotated[
    int, typer.Option("--port", metavar="N", help="Port of the viewer's web page; 0 takes a free one.")
]
HostOption = Annotated[
    str,
    typer.Option(
        "--host", metavar="ADDRESS", help="Address it listens at; by default only this machine reaches it."
    ),
]


def export_names(text: str | None) -> tuple[str, ...]:
    """The formats named in ``--export colmap,glb``."""
    return tuple(dict.fromkeys(name.strip() for name in (text or "").split(",") if name.strip()))
