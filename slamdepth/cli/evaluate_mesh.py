# SPDX-License-Identifier: Apache-2.0
"""``slamdepth evaluate-mesh``: the score of a mesh against a surface that is known."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slamdepth.cli.console import QuietOption, VerboseOption, console, print_notes
from slamdepth.cli.options import CameraOption, FollowLinksOption, MaxFramesOption
from slamdepth.cli.progress import JobBar

if TYPE_CHECKING:
    from slamdepth.pipeline.mesh_evaluation import Alignment, MeshEvaluation, MeshQuestion


def evaluate_mesh_command(
    mesh: Annotated[
        Path,
        typer.Argument(
            metavar="MESH", help="Mesh or point cloud (PLY, OBJ, STL, OFF, PCD), or a run folder."
        ),
    ],
    reference: Annotated[
        Path,
        typer.Argument(
            metavar="REFERENCE",
            help="Mesh or point cloud, or a sequence with sensor depth and ground truth: TUM, 7-Scenes, or "
            "a room of 'slamdepth synth'.",
        ),
    ],
    align: Annotated[
        str | None,
        typer.Option(
            metavar="none|se3|sim3",
            help="Bring the mesh into the reference's frame by the poses of its run. Default: sim3 where "
            "they are known, else none",
        ),
    ] = None,
    trajectory: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Trajectory of the mesh's world. Default: that of the run folder"),
    ] = None,
    max_depth: Annotated[
        float, typer.Option(metavar="M", help="Sensor depth beyond this counts as unknown.")
    ] = 4.0,
    camera: CameraOption = None,
    follow_links: FollowLinksOption = False,
    max_frames: MaxFramesOption = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="FILE",
            help="Write the figures here, as JSON, with both surfaces coloured by error next to it, as PLY "
            "and PNG.",
        ),
    ] = None,
    verbose: VerboseOption = False,
    quiet: QuietOption = False,
) -> None:
    """Score a mesh: accuracy, completion, chamfer, precision, recall and F at 2, 5 and 10 cm.

    Example: slamdepth evaluate-mesh runs/rpy rgbd_dataset_freiburg1_rpy --output rpy-mesh.json

    Example: slamdepth evaluate-mesh scan.ply truth.ply

    Against a sequence, only what its sensor saw is judged. Surfaces are never fitted to each other.
    """
    from slamdepth.datasets import ReadOptions
    from slamdepth.errors import ConfigError
    from slamdepth.io import writable_file
    from slamdepth.pipeline.mesh_evaluation import MeshQuestion, evaluate_mesh

    if not 0 < max_depth < float("inf"):
        raise ConfigError(f"--max-depth must be positive and finite, got {max_depth:g}")
    if output is not None:
        output = writable_file(output, ".json")
    reading = ReadOptions(follow_links=follow_links)
    asked = MeshQuestion(
        mesh, reference, _alignment(align), trajectory, camera, max_frames, max_depth, reading
    )
    with JobBar(quiet) as bar:
        found = evaluate_mesh(asked, lambda done, total: bar.show("reading", done, total))
    files = [] if output is None else _write(output, asked, found)
    _print(asked, found, files, quiet)


def _alignment(name: str | None) -> Alignment | None:
    from slamdepth.errors import ConfigError
    from slamdepth.pipeline.mesh_evaluation import Alignment

    if name is None:
        return None
    try:
        return Alignment(name.lower())
    except ValueError as error:
        known = ", ".join(one.value for one in Alignment)
        raise ConfigError(f"--align must be one of {known}, got '{name}'") from error


def _write(output: Path, asked: MeshQuestion, found: MeshEvaluation) -> list[str]:
    """Write figures and surfaces; returns the names of the files."""
    from slamdepth.io import write_json
    from slamdepth.report.environment import versions
    from slamdepth.report.surface_errors import write_error_image, write_error_ply

    figures: dict[str, Any] = {
        "mesh": asked.mesh.name,
        "reference": asked.reference.name,
        "align": found.align.value,
        "T_reference_mesh": found.T_reference_mesh.tolist(),
        **found.score.to_dict(),
        "notes": list(found.notes),
        "versions": versions(),
    }
    write_json(output, figures)
    surfaces = [(found.estimate, found.accuracy_m), (found.reference, found.completion_m)]
    names = [output.name]
    for kind, (surface, errors_m) in zip(("accuracy", "completion"), surfaces, strict=True):
        ply = output.with_name(f"{output.stem}_{kind}.ply")
        write_error_ply(ply, surface, errors_m)
        names.append(ply.name)
    image = output.with_name(f"{output.stem}.png")
    if found.cameras is not None and write_error_image(image, surfaces, found.cameras):
        names.append(image.name)
    return names


def _print(asked: MeshQuestion, found: MeshEvaluation, files: list[str], quiet: bool) -> None:
    from slamdepth.report import surface_table
    from slamdepth.report.mesh_images import ERROR_COLOURS

    title = f"{asked.mesh.name} against {asked.reference.name}, alignment: {found.align.value}"
    out = console()
    out.print(surface_table(found.score.to_dict(), title))
    if not quiet:
        print_notes(out, found.notes)
        if files:
            out.print(f"figures: {', '.join(files)}; colours: {ERROR_COLOURS}", markup=False, soft_wrap=True)
