# SPDX-License-Identifier: Apache-2.0
"""The input of a report: everything a finished run knows."""

from __future__ import annotations

from dataclasses import dataclass, field

from slamdepth.config import Config
from slamdepth.evaluation import AlignedScores, DepthScore, Health, TrajectoryScore
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapping.reconstruction import Reconstruction
from slamdepth.report.camera import CameraFacts
from slamdepth.report.mesh_images import MeshImage
from slamdepth.report.scale import ScaleFacts
from slamdepth.report.scene.model import Scene
from slamdepth.types import StepResult, WeightsInfo


@dataclass(frozen=True)
class MeshCounts:
    """Size of the mesh that was written."""

    vertices: int
    triangles: int

    @classmethod
    def of(cls, mesh: Mesh | None) -> MeshCounts | None:
        """The size of ``mesh``; None where there is none."""
        return None if mesh is None else cls(len(mesh.vertices_m), len(mesh.triangles))


@dataclass(frozen=True)
class MapData:
    """One of several maps of a run, which have no common frame and no common scale.

    Attributes:
        reconstruction: at its final scale.
        scale: is it metric, and how was its scale found.
        trajectory_score, mesh: None where there is none.
    """

    reconstruction: Reconstruction
    scale: ScaleFacts
    trajectory_score: TrajectoryScore | None = None
    mesh: MeshCounts | None = None


@dataclass(frozen=True)
class ReportData:
    """Everything the report of one run states.

    Attributes:
        sequence: name of the sequence, not its path.
        depth_model: name of the depth model.
        depth_is_measured: True where a sensor measured the depth rather than a network predicted it.
        reconstruction: the largest map at its final scale.
        fps: frames over the wall time of tracking, without meshing.
        config: every setting of the run.
        scale: is the largest map metric, and how was its scale found.
        health: can the result be trusted, where not, and why.
        camera: the camera, and how it is known; None where that is not said.
        weights: every weights file that took part, and the data each has seen.
        steps: one result for each frame, in order; empty where they were not kept.
        trajectory_score, depth_score, mesh: of the largest map; None where there is none.
        surface_scores: of that mesh against what the sequence's sensor saw; None where it was not scored.
        others: the maps that never met the largest one, the largest first.
        mesh_images: views of the mesh; empty where there is none.
        scene: what the 3D view of the page shows; None leaves it out.
        skipped_frames: images that could not be read: damaged, or missing.
        readable_frames, promised_frames: of the whole sequence, and as the header of a video says; None where
            that is not known.
        notes: what was guessed, dropped or repaired, one line each.
        options: what was asked for in addition to the settings.
        files: what each file of the run folder holds, by file name.
    """

    sequence: str
    depth_model: str
    depth_is_measured: bool
    reconstruction: Reconstruction
    fps: float
    config: Config
    scale: ScaleFacts
    health: Health
    camera: CameraFacts | None = None
    weights: tuple[WeightsInfo, ...] = ()
    steps: tuple[StepResult, ...] = ()
    trajectory_score: TrajectoryScore | None = None
    depth_score: DepthScore | None = None
    mesh: MeshCounts | None = None
    surface_scores: AlignedScores | None = None
    others: tuple[MapData, ...] = ()
    mesh_images: tuple[MeshImage, ...] = ()
    scene: Scene | None = None
    skipped_frames: int = 0
    readable_frames: int | None = None
    promised_frames: int | None = None
    notes: tuple[str, ...] = ()
    options: dict[str, object] = field(default_factory=dict)
    files: dict[str, str] = field(default_factory=dict)

    @property
    def maps(self) -> tuple[MapData, ...]:
        """Every map of the run, the largest first."""
        largest = MapData(self.reconstruction, self.scale, self.trajectory_score, self.mesh)
        return (largest, *self.others)
