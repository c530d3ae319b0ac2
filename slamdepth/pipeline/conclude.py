# SPDX-License-Identifier: Apache-2.0
"""A run after its last frame: scale, maps, meshes, exports, scores, report."""

from __future__ import annotations

import logging
from dataclasses import replace

from slamdepth.frontend.features import feature_weights
from slamdepth.mapping.mesh import Mesh
from slamdepth.mapstore import Session
from slamdepth.pipeline.asked import reported_options
from slamdepth.pipeline.camera import check_camera
from slamdepth.pipeline.dense import measure_depth
from slamdepth.pipeline.export import export_results
from slamdepth.pipeline.folder import (
    EXPORTS,
    EXPORTS_CONTENT,
    FILES,
    MAP,
    MAP_CONTENT,
    MAPS,
    MAPS_CONTENT,
)
from slamdepth.pipeline.job import Job
from slamdepth.pipeline.maps import finish_others, settle_others, write_mesh, write_trajectories
from slamdepth.pipeline.options import (
    ProgressCallback,
    RunProgress,
    RunResult,
    RunStage,
)
from slamdepth.pipeline.results import judge_health, judge_trajectory, score_depth
from slamdepth.pipeline.saved_maps import inherited_scale, start_map_notes, write_maps
from slamdepth.pipeline.scale import settle_scale
from slamdepth.pipeline.surface import score_mesh
from slamdepth.pipeline.tracking import Tracked
from slamdepth.report import MeshCounts, MeshImage, ReportData, render_errors, write_report
from slamdepth.report.scene import SCENE_FILE, scene_of, write_scene

logger = logging.getLogger(__name__)


def conclude(job: Job, tracked: Tracked, tell: ProgressCallback) -> RunResult:
    """Everything after tracking; the trajectory first, since it is what was asked for."""
    config, dataset, folder, scale = job.config, job.dataset, job.folder, job.scale
    reconstruction, scale_facts, scale_notes = settle_scale(
        dataset, tracked.reconstruction, scale, config, tell
    )
    camera = check_camera(dataset, job.camera, job.tracker)
    others, other_notes = settle_others(dataset, tracked.reconstruction, scale, config)
    reconstruction = replace(reconstruction, others=tuple(one.reconstruction for one in others))
    maps = (reconstruction, *reconstruction.others)
    write_trajectories(folder, maps)
    scale_facts = inherited_scale(scale_facts, job.tracker, 0, job.start_map)
    write_maps(
        folder,
        job.tracker,
        Session(dataset.name, job.model.name),
        (tracked.reconstruction, *tracked.reconstruction.others),
        maps,
        (scale_facts, *(one.scale for one in others)),
        with_images=job.options.map_images,
    )
    notes = [*dataset.notes, *tracked.notes, *scale_notes, *other_notes]
    notes += start_map_notes(job.tracker, job.start_map, with_images=job.options.map_images)
    mesh: Mesh | None = None
    mesh_images: tuple[MeshImage, ...] = ()
    if job.options.mesh:
        reconstruction = measure_depth(dataset, reconstruction, config, tell)
        mesh, mesh_images, mesh_notes = write_mesh(folder, 1, reconstruction, config, tell)
        notes += mesh_notes
    is_measured = job.depth_is_measured
    others, other_meshes, other_notes = finish_others(
        dataset,
        others,
        config,
        folder,
        tell,
        mesh=job.options.mesh,
        is_measured=is_measured,
    )
    notes += other_notes

    notes += export_results(
        folder,
        dataset,
        (reconstruction, *(one.reconstruction for one in others)),
        (scale_facts.sentence, *(one.scale.sentence for one in others)),
        job.options.exports,
        tell,
    )

    tell(RunProgress(RunStage.SCORING))
    trajectory_score, score_notes = judge_trajectory(
        dataset, reconstruction.trajectory, is_measured=is_measured
    )
    depth_score, depth_notes = score_depth(dataset, reconstruction.keyframes)
    surface_scores, errors_m, surface_notes = score_mesh(
        dataset,
        job.indices[: len(tracked.steps) + tracked.skipped],
        mesh,
        reconstruction.trajectory,
        lambda done, total: tell(RunProgress(RunStage.COMPARING, done, total)),
        is_measured=is_measured,
    )
    if mesh is not None and errors_m is not None:
        mesh_images += render_errors(mesh, errors_m, reconstruction)
    optional = (
        ("mesh.ply", mesh),
        ("cloud.ply", (folder / "cloud.ply").is_file()),
        ("mesh.png", mesh_images),
        ("depth_scale.yaml", scale.fit),
    )
    absent = {name for name, is_there in optional if not is_there}
    files = {name: what for name, what in FILES.items() if name not in absent}
    if (folder / MAP).is_dir():
        files[f"{MAP}/"] = MAP_CONTENT
    files |= {MAPS: MAPS_CONTENT} if others else {}
    files |= {EXPORTS: EXPORTS_CONTENT} if (folder / EXPORTS).is_dir() else {}
    tell(RunProgress(RunStage.REPORTING))
    scene = scene_of(
        replace(reconstruction, others=tuple(one.reconstruction for one in others)),
        (mesh, *other_meshes),
        (trajectory_score, *(one.trajectory_score for one in others)),
    )
    write_scene(folder / SCENE_FILE, scene)
    summary = write_report(
        folder.path,
        ReportData(
            sequence=dataset.name,
            depth_model=job.model.name,
            depth_is_measured=is_measured,
            reconstruction=reconstruction,
            fps=tracked.fps,
            config=config,
            scale=scale_facts,
            health=judge_health(
                reconstruction,
                tracked.steps,
                config,
                scale_facts,
                is_measured=is_measured,
                camera_is_guessed=camera.is_a_guess,
            ),
            camera=camera,
            weights=(*job.model.weights, *feature_weights(config.features)),
            steps=tracked.steps,
            trajectory_score=trajectory_score,
            depth_score=depth_score,
            mesh=MeshCounts.of(mesh),
            surface_scores=surface_scores,
            others=others,
            mesh_images=mesh_images,
            scene=scene,
            skipped_frames=tracked.skipped,
            readable_frames=len(dataset),
            promised_frames=getattr(dataset, "frames_promised", len(dataset)),
            notes=(*notes, *score_notes, *depth_notes, *surface_notes),
            options=reported_options(job.options, tracked),
            files=files,
        ),
    )
    logger.info("done: %s", folder.path)
    return RunResult(folder.path, summary, reconstruction, tracked.interrupted)
