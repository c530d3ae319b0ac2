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
