# SPDX-License-Identifier: Apache-2.0
"""``slamdepth run``: the main job."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes, print_places
from slamdepth.cli.options import (
    CameraOption,
    DepthTopicOption,
    DepthWeightsOption,
    FollowLinksOption,
    FovOption,
    MaxFramesOption,
    PortOption,
    PoseTopicOption,
    SecondsOption,
    StrideOption,
    TopicOption,
    export_names,
)
from slamdepth.cli.progress import JobBar
from slamdepth.cli.signals import stop_on_signals
from slamdepth.cli.view import live_view

if TYPE_CHECKING:
    from slamdepth.config import Config
    from slamdepth.pipeline import RunProgress, RunResult

_PLACES = {
    "results": "",
    "trajectory": "trajectory.txt",
    "other maps": "maps",
    "mesh file": "mesh.ply",
    "map": "map",
    "report": "report.html",
    "exports": "export",
}


def run_command(
    sequence: Annotated[
        Path | None,
        typer.Argument(
            metavar="SEQ",
            help="A video, a folder of images or of a known layout, a bag, or a live source such as "
            "camera:0; 'slamdepth info SEQ' tells what it is.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", metavar="DIR", help="Run folder. Default: runs/<sequence>-<time>"),
    ] = None,
    depth: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help="Depth model, hf:ORG/NAME of the hub, hf:FOLDER, or 'sensor'; an unknown name lists all "
            "names. Default: auto, the best metric model in the cache folder, else dinov2",
        ),
    ] = None,
    depth_weights: DepthWeightsOption = None,
    depth_scale: Annotated[
        str | None,
        typer.Option(
            metavar="FILE|X|groundtruth",
            help="Multiply predicted depth: by a file of 'slamdepth scale', by a number, or by a "
            "factor from this sequence's ground truth.",
        ),
    ] = None,
    marker: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FAMILY:SIDE",
            help="AprilTag or ArUco markers in the video, their black square SIDE metres wide: "
            "tag36h11:0.16, or tag36h11:0.16:7 for number 7 alone. May be repeated.",
        ),
    ] = None,
    imu: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Inertial data of the same time, CSV of EuRoC or a phone app: scale and gravity.",
        ),
    ] = None,
    camera_height: Annotated[
        float | None,
        typer.Option(metavar="M", help="Height of the (first) camera over the floor or road in metres."),
    ] = None,
    baseline_m: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Distance in metres from the first camera to the last; or see --baseline-between.",
        ),
    ] = None,
    baseline_between: Annotated[
        tuple[float, float] | None,
        typer.Option(metavar="T1 T2", help="Timestamps --baseline-m is between: seconds, as in rgb.txt."),
    ] = None,
    odometry: Annotated[
        str | None,
        typer.Option(metavar="orb|kiss-icp", help="What estimates the motion. Default: orb"),
    ] = None,
    features: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Keypoints: orb, sift, ...; an unknown name lists all. Default: orb"
        ),
    ] = None,
    features_weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="ONNX file of features that are a network: aliked.")
    ] = None,
    features_matcher: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="LightGlue's ONNX file, to match whole images with."),
    ] = None,
    single_map: Annotated[
        bool,
        typer.Option(
            "--single-map", help="Start no new map where the camera stays lost; keep looking for the first."
        ),
    ] = False,
    camera: CameraOption = None,
    fov: FovOption = None,
    readout_ms: Annotated[
        float | None,
        typer.Option(
            metavar="MS",
            help="Milliseconds the camera takes from an image's first row to its last (rolling shutter); "
            "0 for a global shutter. Default: estimated from the motion",
        ),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="FILE", help="YAML file with settings; options here win.")
    ] = None,
    topic: TopicOption = None,
    depth_topic: DepthTopicOption = None,
    pose_topic: PoseTopicOption = None,
    follow_links: FollowLinksOption = False,
    max_frames: MaxFramesOption = None,
    seconds: SecondsOption = None,
    stride: StrideOption = 1,
    dense: Annotated[
        str | None,
        typer.Option(
            metavar="off|fast|best",
            help="Measure the depth of keyframes from many views, for the mesh; 'best' takes five times as "
            "long. Default: fast for predicted depth, off for a sensor's",
        ),
    ] = None,
    no_mesh: Annotated[bool, typer.Option("--no-mesh", help="Make no mesh.")] = False,
    voxel_size: Annotated[
        float | None, typer.Option(metavar="M", help="Edge of the mesh's voxels in metres. Default: 0.02")
    ] = None,
    export: Annotated[
        str | None,
        typer.Option(
            metavar="NAME[,NAME]",
            help="Also export the result to colmap, nerfstudio, ...; see 'slamdepth export --help'.",
        ),
    ] = None,
    device: Annotated[
        str | None, typer.Option(metavar="cpu|cuda", help="Where the network runs. Default: cpu")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(metavar="N", help="Seed of everything random. Default: 0")
    ] = None,
    start_map: Annotated[
        Path | None,
        typer.Option(
            "--map",
            metavar="RUN",
            help="Go on from the map of an earlier run, and extend it.",
        ),
    ] = None,
    map_images: Annotated[
        bool, typer.Option("--map-images", help="Keep the keyframes' images in the run's map.")
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(
            "--resume",
            metavar="RUN",
            help="Go on with a run that was killed, from its last checkpoint; SEQ only where it was moved.",
        ),
    ] = None,
    checkpoint_every: Annotated[
        float | None,
        typer.Option(metavar="S", help="Seconds from one checkpoint to the next; 0: none. Default: 15"),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace an earlier run in the output folder.")
    ] = False,
    view: Annotated[
        bool,
        typer.Option("--view", help="Show the map in the browser while it grows; needs the extra 'viewer'."),
    ] = False,
    port: PortOption = 8080,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Track a video sequence, mesh it, score it, write a report.

    Example: slamdepth run rgbd_dataset_freiburg1_desk --depth dinov2 --output runs/desk

    Example: slamdepth run rgbd_dataset_freiburg1_rpy --depth sensor --features sift

    Example: slamdepth run walk.mp4 --camera camera.yaml --marker tag36h11:0.16

    Example: slamdepth run walk2.mp4 --map runs/walk

    Example: slamdepth run --resume runs/walk

    Example: slamdepth run recording.bag --topic /camera/color/image_raw

    Example: slamdepth run camera:0 --camera webcam.yaml --seconds 60

    Ctrl-C finishes the run with the frames it has; a second Ctrl-C aborts it.
    """
    if resume is not None:
        _resume(resume, sequence, quiet)
        return
    if sequence is None:
        from slamdepth.errors import ConfigError

        raise ConfigError("Missing argument 'SEQ'. Usage: slamdepth run SEQ (see 'slamdepth run --help')")
    settings = _settings(
        config,
        {
            "odometry": odometry,
            "device": device,
            "seed": seed,
            "features": {
                "name": features,
                "weights": _text(features_weights),
                "matcher": _text(features_matcher),
            },
            "depth": {"name": depth, "weights": _text(depth_weights)},
            "scale": {
                "depth": depth_scale,
                "marker": marker or None,
                "imu": _text(imu),
                "camera_height_m": camera_height,
                "baseline_m": baseline_m,
                "baseline_between_s": baseline_between,
            },
            "tracking": {"new_maps": False if single_map else None},
            "shutter": {"readout_ms": readout_ms},
            "dense": {"mode": dense},
            "map": {"voxel_size_m": voxel_size},
        },
    )
    from slamdepth.datasets import ReadOptions
    from slamdepth.pipeline import run

    with stop_on_signals() as stop, live_view(port if view else None) as watcher, JobBar(quiet) as bar:
        result = run(
            sequence,
            output,
            camera=camera,
            view_deg=fov,
            config=settings,
            max_frames=max_frames,
            stride=stride,
            mesh=not no_mesh,
            overwrite=overwrite,
            export=export_names(export),
            start_map=start_map,
            map_images=map_images,
            checkpoint_s=checkpoint_every,
            reading=ReadOptions(topic, depth_topic, pose_topic, follow_links, seconds),
            progress=lambda step: _show(bar, step),
            stop=stop,
            watcher=watcher,
        )
    _print_result(result, quiet)


def _resume(folder: Path, sequence: Path | None, quiet: bool) -> None:
    """Go on with a run that was killed."""
    from slamdepth.pipeline.resume import is_finished, resume

    if is_finished(folder):
        console().print(f"{folder}: the run is finished", markup=False, soft_wrap=True)
        return
    with stop_on_signals() as stop, JobBar(quiet) as bar:
        result = resume(folder, sequence=sequence, progress=lambda step: _show(bar, step), stop=stop)
    _print_result(result, quiet)


def _settings(path: Path | None, asked: dict[str, Any]) -> Config:
    """Settings of the command line over those of the YAML file over defaults; None means not given."""
    from slamdepth.config import Config

    overrides: dict[str, Any] = {}
    for name, value in asked.items():
        if isinstance(value, dict):
            value = {key: inner for key, inner in value.items() if inner is not None}
        if value is not None and value != {}:
            overrides[name] = value
    if path is None:
        return Config.from_dict(overrides, origin="command line")
    return Config.from_yaml(path, overrides)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


def _show(bar: JobBar, progress: RunProgress) -> None:
    state = ""
    if progress.status is not None:
        state = (
            f"{progress.fps:.1f} fps · {progress.status.value} · "
            f"keyframes {progress.keyframes} · loops {progress.loop_closures}"
        )
    bar.show(progress.stage.value, progress.done, progress.total, state)


def _print_result(result: RunResult, quiet: bool) -> None:
    from slamdepth.report import run_table

    places = {
        name: str(result.folder / file)
        for name, file in _PLACES.items()
        if not file or (result.folder / file).exists()
    }
    out = console()
    out.print(run_table(result.summary))
    print_places(out, places)
    if not quiet:
        print_notes(out, result.summary["notes"])
