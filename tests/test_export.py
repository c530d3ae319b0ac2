# SPDX-License-Identifier: Apache-2.0
"""Exports of a finished run, read back as other tools read them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import call, leave_out_plots, slamdepth
from nerfstudio_rules import read_transforms
from wide_world import wide_camera

import slamdepth as package
from slamdepth.datasets import Dataset, open_dataset
from slamdepth.errors import ConfigError, DatasetError, InputError, OutputError, TrackingError
from slamdepth.export import FORMATS, ExportRequest, ExportScene, ImageMode, View, write_export
from slamdepth.export.formats.euroc import nanoseconds
from slamdepth.export.images import ExportImages
from slamdepth.export.tracks import MAX_ERROR_PX, build_tracks
from slamdepth.export.upright import y_up, z_up
from slamdepth.geometry import invert, se3_exp
from slamdepth.io import read_tum_trajectory, write_camera
from slamdepth.open3d_loader import import_open3d
from slamdepth.pipeline import RunResult
from slamdepth.pipeline.export import _recording, export_results
from slamdepth.pipeline.folder import RunFolder, recorded_arguments
from slamdepth.types import Camera, Frame, Trajectory

ALL = ("colmap", "euroc", "glb", "kitti", "nerfstudio", "obj", "ply", "tum")


@pytest.fixture(scope="module")
def result(tiny_room: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunResult]:
    """A run of the tiny room that exported to everything but Rerun."""
    with pytest.MonkeyPatch.context() as patch:
        leave_out_plots(patch)
        yield package.run(
            tiny_room,
            tmp_path_factory.mktemp("export") / "run",
            depth="sensor",
            config=package.Config.from_dict({"map": {"voxel_size_m": 0.08}}),
            export=ALL,
        )


def test_every_format_is_registered() -> None:
    assert set(FORMATS.names()) == {*ALL, "rerun"}


def test_pycolmap_reads_the_sparse_model(result: RunResult) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = result.folder / "export" / "colmap"
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    keyframes = result.reconstruction.keyframes
    assert model.num_reg_images() == len(keyframes)
    assert model.compute_mean_reprojection_error() < 1.0
    assert model.num_points3D() > 100
    assert min(point.track.length() for point in model.points3D.values()) >= 2
    camera = model.cameras[1]
    assert camera.model.name == "PINHOLE"
    for number, keyframe in enumerate(keyframes):
        image = model.images[number + 1]
        found = np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]])
        np.testing.assert_allclose(found, invert(keyframe.T_world_camera), atol=1e-9)
        pixels = cv2.imread(str(folder / "images" / image.name))
        assert pixels is not None
        assert pixels.shape[:2] == (camera.height, camera.width)


def test_the_error_of_points_is_that_which_pycolmap_computes(result: RunResult) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    model = pycolmap.Reconstruction(result.folder / "export" / "colmap" / "sparse" / "0")
    stated = np.array([point.error for _, point in sorted(model.points3D.items())])
    model.update_point_3d_errors()
    np.testing.assert_allclose([p.error for _, p in sorted(model.points3D.items())], stated, atol=1e-6)


def test_points_have_the_colours_of_the_images(result: RunResult, tiny_room: Path) -> None:
    scene = ExportScene.of(result.reconstruction, "room")
    dataset = open_dataset(tiny_room)
    images = ExportRequest(scene, dataset).images()
    cloud = import_open3d().io.read_point_cloud(str(result.folder / "export" / "nerfstudio" / "points.ply"))
    tracks = build_tracks(scene, images)
    shown = images.image(scene.views[0])
    seen = np.flatnonzero(tracks.rows[0] >= 0)
    x, y = np.rint(tracks.keypoints_px[0][seen]).astype(int).T
    colors = np.asarray(cloud.colors)[tracks.rows[0][seen]] * 255
    assert np.median(np.abs(colors - shown[y, x])) < 25


def test_nerfstudio_reads_the_cameras_and_points(result: RunResult) -> None:
    folder = result.folder / "export" / "nerfstudio"
    read = read_transforms(folder)
    scene = ExportScene.of(result.reconstruction, "room")
    assert len(read.T_world_camera) == len(scene.views)
    # what the parser makes of it sees the points where the map's cameras see them
    T = np.array(json.loads((folder / "transforms.json").read_text())["slamdepth_T_file_world"])
    np.testing.assert_allclose(T @ T.T, np.eye(4), atol=1e-9)
    for T_file_camera, view in zip(read.T_world_camera, scene.views, strict=True):
        np.testing.assert_allclose(T_file_camera, T @ view.T_world_camera, atol=1e-6)
    px = read.project(0, read.points)
    inside = (px > 0).all(axis=1) & (px < [read.width, read.height]).all(axis=1)
    assert inside.mean() > 0.3
    gravity = result.reconstruction.gravity_w
    if gravity is not None:
        np.testing.assert_allclose(T[:3, :3] @ gravity, [0, 0, -1], atol=1e-6)


def test_trajectories_read_back(result: RunResult) -> None:
    folder, expected = result.folder / "export", result.trajectory
    tum, _ = read_tum_trajectory(folder / "tum" / "trajectory.txt")
    euroc, _ = read_tum_trajectory(folder / "euroc" / "data.csv")
    for found in (tum, euroc):
        np.testing.assert_allclose(found.timestamps_s, expected.timestamps_s, atol=1e-9)
        np.testing.assert_allclose(found.T_world_camera, expected.T_world_camera, atol=1e-7)
    rows = np.loadtxt(folder / "kitti" / "poses.txt")
    np.testing.assert_allclose(rows.reshape(-1, 3, 4), expected.T_world_camera[:, :3], atol=1e-7)
    np.testing.assert_array_equal(np.loadtxt(folder / "kitti" / "times.txt"), expected.timestamps_s)


@pytest.mark.parametrize("file", ["ply/mesh.ply", "obj/mesh.obj", "glb/mesh.glb"])
def test_meshes_read_back(result: RunResult, file: str) -> None:
    read = import_open3d().io.read_triangle_mesh(str(result.folder / "export" / file))
    assert len(read.triangles) == result.summary["mesh"]["triangles"]
    assert read.has_vertex_colors()


def test_a_readme_says_frame_unit_and_scale(result: RunResult) -> None:
    for name in ALL:
        text = (result.folder / "export" / name / "README.txt").read_text()
        assert text.startswith(f"An export of slamdepth of 'room' to {name}: ")
        assert "x right, y down, z forward" in text
        assert result.summary["scale"]["sentence"] in text


def test_rerun_opens_the_recording(result: RunResult, tmp_path: Path, tiny_room: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: 500 MB")
    scene = ExportScene.of(result.reconstruction, "room", mesh=result.folder / "mesh.ply")
    write_export(ExportRequest(scene, open_dataset(tiny_room)), "rerun", tmp_path / "out")
    assert (tmp_path / "out" / "scene.rrd").read_bytes()[:4] == b"RRF2"


def test_without_its_package_rerun_is_refused_before_any_work(
    monkeypatch: pytest.MonkeyPatch, tiny_room: Path, tmp_path: Path
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'slamdepth\[rerun\]'"):
        package.run(tiny_room, tmp_path / "run", depth="sensor", export=("rerun",))
    assert not (tmp_path / "run").exists()


def test_a_run_folder_is_exported_by_the_command(result: RunResult, tmp_path: Path) -> None:
    done = slamdepth(
        "export", result.folder, "--to", "nerfstudio,tum", "--output", tmp_path / "out", "--quiet"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [str(tmp_path / "out" / name) for name in ("nerfstudio", "tum")]
    read = read_transforms(tmp_path / "out" / "nerfstudio")
    assert len(read.T_world_camera) == len(result.reconstruction.keyframes)


def test_every_frame_can_be_exported(result: RunResult, tmp_path: Path) -> None:
    folder = package.export_run(
        result.folder, "nerfstudio", tmp_path / "all", every_frame=True, images="none"
    )
    frames = json.loads((folder / "transforms.json").read_text())["frames"]
    assert len(frames) == len(result.trajectory)
    assert not (folder / "images").exists()


def test_the_saved_map_exports_as_the_run_did(result: RunResult, tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = package.export_run(result.folder, "colmap", tmp_path / "out")
    later, then = (
        pycolmap.Reconstruction(place / "sparse" / "0")
        for place in (folder, result.folder / "export" / "colmap")
    )
    assert later.num_points3D() == then.num_points3D()
    assert later.compute_mean_reprojection_error() == pytest.approx(
        then.compute_mean_reprojection_error(), rel=1e-3
    )
    for number, image in then.images.items():
        np.testing.assert_allclose(
            later.images[number].cam_from_world().matrix(), image.cam_from_world().matrix(), atol=1e-9
        )
    text = (folder / "README.txt").read_text()
    assert text == (result.folder / "export" / "colmap" / "README.txt").read_text()


def test_poses_are_exported_with_the_camera_that_they_were_tracked_with(
    result: RunResult, tmp_path: Path, tiny_room: Path
) -> None:
    room = tmp_path / "room"
    shutil.copytree(tiny_room, room)
    tracked = result.reconstruction.keyframes[0].frame.camera
    write_camera(room / "camera.yaml", replace(tracked, fx=1.2 * tracked.fx, fy=1.2 * tracked.fy))
    by_run, by_user = (
        json.loads((folder / "transforms.json").read_text())["fl_x"]
        for folder in (
            package.export_run(
                result.folder, "nerfstudio", tmp_path / name, images="raw", recording=room, camera=camera
            )
            for name, camera in (("by_run", None), ("by_user", room / "camera.yaml"))
        )
    )
    assert by_run == pytest.approx(tracked.fx)
    assert by_user == pytest.approx(1.2 * tracked.fx)


def test_a_run_that_added_no_keyframe_to_its_map_is_exported(
    result: RunResult, tmp_path: Path, tiny_room: Path
) -> None:
    run = tmp_path / "run"
    shutil.copytree(result.folder, run, ignore=shutil.ignore_patterns("export", "map"))
    (run / "keyframes.txt").write_text("# timestamp tx ty tz qx qy qz qw\n")
    poses, _ = read_tum_trajectory(package.export_run(run, "tum") / "trajectory.txt")
    assert len(poses) == len(result.trajectory)
    with pytest.raises(InputError, match=r"no keyframe to export.*--every-frame"):
        package.export_run(run, "nerfstudio")
    folder = package.export_run(run, "nerfstudio", every_frame=True)
    assert len(json.loads((folder / "transforms.json").read_text())["frames"]) == len(result.trajectory)
    bare = replace(result.reconstruction, keyframes=())
    notes = export_results(
        RunFolder(run), open_dataset(tiny_room), [bare], [""], ["kitti", "colmap"], lambda state: None
    )
    assert len(notes) == 1
    assert "no keyframe to export" in notes[0]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--to", "gltf"], "unknown export format 'gltf'; choose from: colmap, euroc, glb"),
        (["--to", ","], "--to names no format"),
        (["--to", "tum", "--images", "all"], "images must be one of undistorted, raw, none"),
        (["--to", "tum", "--map", "2"], "has no map 2"),
        (["--to", "tum"], "holds an earlier export; name another folder or add --overwrite"),
        (["--to", "nerfstudio", "--overwrite", "--recording", "nowhere"], "nowhere: no such folder"),
    ],
)
def test_bad_input_is_one_line(result: RunResult, arguments: list[str], says: str) -> None:
    done = call("export", result.folder, *arguments)
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("file", "data", "to", "says"),
    [
        ("report.json", None, "tum", "the run did not end"),
        ("report.json", b"[1]", "tum", "is no report of a run"),
        ("report.json", b"{", "tum", "cannot be read"),
        ("trajectory.txt", b"1 2 3\n", "tum", "trajectory.txt:1"),
        ("keyframes.txt", None, "kitti", "keyframes.txt"),
        ("mesh.ply", b"ply\nformat", "obj", "holds no mesh, or is damaged"),
        ("mesh.ply", None, "glb", "has no mesh to export: run it without --no-mesh"),
        ("map/map.json", b"{}", "colmap", "is no map of slamdepth"),
        ("map/keyframes.safetensors", b"x", "nerfstudio", "keyframes.safetensors"),
        ("README.txt", b"A run of slamdepth", "colmap", "name it by --recording"),
        ("README.txt", b"A run of slamdepth\n  slamdepth run gone.mp4", "colmap", "the run was started in"),
    ],
)
def test_a_damaged_run_is_one_line(
    result: RunResult, tmp_path: Path, file: str, data: bytes | None, to: str, says: str
) -> None:
    run = tmp_path / "run"
    shutil.copytree(result.folder, run, ignore=shutil.ignore_patterns("export"))
    (run / file).unlink()
    if data is not None:
        (run / file).write_bytes(data)
    done = call("export", run, "--to", to)
    assert done.returncode == 2, done.stderr
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (run / "export" / to).exists()


def test_the_images_of_a_pattern_are_found_again(tmp_path: Path) -> None:
    for number in range(3):
        cv2.imwrite(str(tmp_path / f"img_{number}.png"), np.full((48, 64, 3), 40 * number, np.uint8))
    folder = RunFolder.plan(tmp_path / "run", "walk", overwrite=False)
    folder.create([str(tmp_path / "img_*.png")])
    assert len(_recording(folder.path, None, None)) == 3
    for image in tmp_path.glob("img_*.png"):
        image.unlink()
    with pytest.raises(InputError, match="name it by --recording"):
        _recording(folder.path, None, None)


@pytest.mark.parametrize("source", ["camera:7", "http://user:secret@127.0.0.1:9/video"])
def test_a_live_source_is_not_opened_again(tmp_path: Path, source: str) -> None:
    folder = RunFolder.plan(tmp_path / "run", "live", overwrite=False)
    folder.create([source])
    with pytest.raises(InputError, match="live source, whose images are not kept") as told:
        _recording(folder.path, None, None)
    assert "secret" not in str(told.value)


def test_a_format_that_fails_stops_no_other(result: RunResult, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(result.folder, run, ignore=shutil.ignore_patterns("export"))
    (run / "mesh.ply").unlink()
    done = call("export", run, "--to", "glb,tum,obj,kitti")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "not exported to glb: " in done.stderr
    assert "not exported to obj: " in done.stderr
    assert sorted(path.name for path in (run / "export").iterdir()) == ["kitti", "tum"]
    assert str(run / "export" / "tum") in done.stdout.replace("\n", "")


def test_what_no_input_can_mend_has_another_exit_code(
    result: RunResult, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(run: Path, to: str, *_: object, **__: object) -> Path:
        if to == "tum":
            return tmp_path
        raise TrackingError("it cannot be done") if to == "kitti" else InputError("it lacks something")

    monkeypatch.setattr("slamdepth.pipeline.export.export_run", fails)
    done = call("export", result.folder, "--to", "tum,kitti")
    assert (done.returncode, "not exported to kitti: it cannot be done" in done.stderr) == (1, True)
    assert call("export", result.folder, "--to", "tum,kitti,ply").returncode == 2


def test_what_fails_for_every_format_is_said_once(tmp_path: Path) -> None:
    done = call("export", tmp_path, "--to", "tum,kitti")
    assert done.returncode == 2
    assert done.stderr.count("is no run folder") == 1


def test_an_export_that_fails_leaves_no_folder(result: RunResult, tmp_path: Path, tiny_room: Path) -> None:
    scene = ExportScene.of(result.reconstruction, "room")
    dataset = open_dataset(tiny_room)

    def gone(index: int) -> Frame:
        raise DatasetError("a live source keeps no images")

    dataset.read_original = gone  # type: ignore[method-assign]
    folder = RunFolder(tmp_path / "run")
    folder.create()
    notes = export_results(folder, dataset, [result.reconstruction], [""], ["colmap"], lambda state: None)
    assert "a live source keeps no images" in notes[0]
    assert not (folder.path / "export").exists()
    with pytest.raises(DatasetError):
        write_export(ExportRequest(scene, dataset), "colmap", tmp_path / "a" / "b" / "out")
    assert not (tmp_path / "a").exists()


def test_raw_images_of_a_wide_lens_are_called_views(tmp_path: Path) -> None:
    (tmp_path / "wide").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "wide" / f"{number}.png"), np.full((256, 256, 3), 90 * number, np.uint8))
    write_camera(tmp_path / "lens.yaml", wide_camera(256))
    view = open_dataset(tmp_path / "wide", tmp_path / "lens.yaml")
    frame = view.read(0)
    scene = ExportScene(
        "wide", Trajectory(np.zeros(1), np.eye(4)[None]), (View(frame.timestamp_s, np.eye(4)),)
    )
    write_export(ExportRequest(scene, view, ImageMode.RAW), "nerfstudio", tmp_path / "out")
    text = (tmp_path / "out" / "README.txt").read_text()
    assert "which is not as they were taken" in text
    assert "undistorted to a pinhole view of" in text
    camera = json.loads((tmp_path / "out" / "transforms.json").read_text())
    assert (camera["w"], camera["h"]) == (frame.camera.width, frame.camera.height)


def test_what_is_no_run_is_refused(tmp_path: Path) -> None:
    done = call("export", tmp_path, "--to", "tum")
    assert done.returncode == 2
    assert "is no run folder" in done.stderr


def test_another_recording_is_refused(result: RunResult, tmp_path: Path, tiny_room: Path) -> None:
    scene = ExportScene.of(result.reconstruction, "room")
    later = replace(
        scene, views=tuple(replace(view, timestamp_s=view.timestamp_s + 9) for view in scene.views)
    )
    with pytest.raises(InputError, match="name the recording of this run"):
        write_export(ExportRequest(later, open_dataset(tiny_room)), "colmap", tmp_path / "out")
    assert not list(tmp_path.iterdir())


def test_a_folder_of_something_else_is_never_replaced(result: RunResult, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match="holds no earlier export"):
        package.export_run(result.folder, "tum", tmp_path, overwrite=True)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_a_mesh_that_cannot_be_read_is_named(result: RunResult, tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(result.folder, run, ignore=shutil.ignore_patterns("export"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "is_file", lambda path: True)  # gone by the time it is copied
        (run / "cloud.ply").unlink()
        with pytest.raises(InputError, match=r"cloud\.ply: cannot be read: No such file"):
            package.export_run(run, "ply", tmp_path / "ply")
    assert not (tmp_path / "ply").exists()


def test_an_export_is_replaced_whole(result: RunResult, tmp_path: Path) -> None:
    for name in ("kitti", "tum"):
        package.export_run(result.folder, name, tmp_path / "out", overwrite=True)
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"README.txt", "trajectory.txt"}
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_same_export_has_the_same_bytes(result: RunResult, tmp_path: Path) -> None:
    for name in ("nerfstudio", "glb"):
        first, second = (package.export_run(result.folder, name, tmp_path / f"{name}{n}") for n in range(2))
        for path in sorted(first.rglob("*.*")):
            assert path.read_bytes() == (second / path.relative_to(first)).read_bytes(), path


def test_the_arguments_of_a_run_are_found_again(result: RunResult, tiny_room: Path) -> None:
    assert recorded_arguments(result.folder)[0] == str(tiny_room)


# -- images and keypoints, on a scene that is known exactly

CAMERA = Camera(320, 240, 260.0, 262.0, 158.0, 121.0, (-0.2, 0.05, 0.001, -0.002, 0.0))


def exact_scene(readout_s: float = 0.0, camera: Camera = CAMERA) -> ExportScene:
    """A camera turning past points four metres away; keypoints are where lens and shutter put them."""
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-3, 3, 400), rng.uniform(-1.5, 1.5, 400), np.full(400, 4.0)])
    times = np.arange(12) / 30.0
    velocity = np.array([0.1, 0.0, 0.0, 0.0, 0.6, 0.1])

    def pose(time_s: float) -> np.ndarray:
        return np.asarray(se3_exp(velocity * time_s))

    def pixels(T_world_camera: np.ndarray) -> np.ndarray:
        points_c = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
        zero = np.zeros(3)
        px, _ = cv2.projectPoints(points_c, zero, zero, camera.K, camera.distortion_array)
        return np.asarray(px[:, 0], np.float64)

    views = []
    for time_s in times.tolist():
        px = pixels(pose(time_s))
        for _ in range(4):  # each point at the time of its own row
            rows = px[:, 1] / camera.height - 0.5
            px = np.array([pixels(pose(time_s + readout_s * row))[n] for n, row in enumerate(rows)])
        shown = (px > 2).all(axis=1) & (px < [camera.width - 3, camera.height - 3]).all(axis=1)
        at = np.flatnonzero(shown)
        views.append(View(time_s, pose(time_s), px[at], at))
    trajectory = Trajectory(times, np.array([pose(time_s) for time_s in times.tolist()]))
    return ExportScene("exact", trajectory, tuple(views), camera, points, readout_s)


@pytest.mark.parametrize(("mode", "readout_s"), [("raw", 0.0), ("none", 0.0), ("none", 0.02)])
def test_exact_keypoints_are_reprojected_exactly(mode: str, readout_s: float) -> None:
    scene = exact_scene(readout_s)
    tracks = build_tracks(scene, ExportImages(scene, None, ImageMode(mode)))
    assert tracks.mean_error_px < (0.02 if readout_s == 0 else 0.15)
    assert len(tracks.points_m) > 100


def test_a_rolling_shutter_left_in_the_images_is_seen_in_the_error() -> None:
    scene = exact_scene(0.02)
    raw = build_tracks(scene, ExportImages(scene, None, ImageMode.RAW))
    corrected = build_tracks(scene, ExportImages(scene, None, ImageMode.NONE))
    assert raw.mean_error_px > 5 * corrected.mean_error_px


def test_keypoints_that_do_not_fit_are_left_out() -> None:
    scene = exact_scene()
    first = scene.views[0]
    px = first.keypoints_px.copy()
    px[:5] += 3 * MAX_ERROR_PX
    moved = replace(scene, views=(replace(first, keypoints_px=px), *scene.views[1:]))
    tracks = build_tracks(moved, ExportImages(moved, None, ImageMode.RAW))
    assert (tracks.rows[0][:5] == -1).all()
    assert tracks.error_px.max() < 0.02


class LargeRecording(Dataset):
    """The recording of :func:`exact_scene` in three times the size that was tracked."""

    name, path, has_depth, ground_truth = "large", Path("large"), False, None

    def __init__(self, scene: ExportScene) -> None:
        self.notes: list[str] = []
        self.camera, self.timestamps_s = CAMERA, scene.trajectory.timestamps_s
        self.large = CAMERA.scaled(960, 720)

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        raise AssertionError("the original is asked for")

    def read_original(self, index: int) -> Frame:
        image = np.random.default_rng(index).integers(0, 256, (720, 960, 3), np.uint8)
        return Frame(index, float(self.timestamps_s[index]), image, self.large)


@pytest.mark.parametrize("mode", ["raw", "undistorted"])
def test_images_have_the_size_of_the_recording(mode: str, tmp_path: Path) -> None:
    scene = exact_scene()
    images = ExportImages(scene, LargeRecording(scene), ImageMode(mode))
    assert images.magnification == 3.0
    assert images.image(scene.views[0]).shape == (images.camera.height, images.camera.width, 3)
    assert images.camera.width > 900
    tracks = build_tracks(scene, images)
    assert tracks.mean_error_px < 0.06


def test_a_keypoint_may_be_off_by_as_many_tracked_pixels_in_a_large_image() -> None:
    scene = exact_scene()
    first = scene.views[0]
    px = first.keypoints_px + np.array([MAX_ERROR_PX - 1, 0])
    moved = replace(scene, views=(replace(first, keypoints_px=px), *scene.views[1:]))
    large = build_tracks(moved, ExportImages(moved, LargeRecording(moved), ImageMode.RAW))
    assert np.count_nonzero(large.rows[0] >= 0) > 50


def test_undistorted_images_show_something_everywhere() -> None:
    barrel = replace(CAMERA, distortion=(0.3, 0.0, 0.0, 0.0, 0.0))
    scene = exact_scene(camera=barrel)
    images = ExportImages(scene, None, ImageMode.UNDISTORTED)
    exported = images.camera
    assert exported.width < barrel.width
    corners = np.array([[0, 0], [exported.width - 1, 0], [0, exported.height - 1],
                        [exported.width - 1, exported.height - 1]], np.float64)  # fmt: skip
    rays = np.column_stack([(corners - [exported.cx, exported.cy]) / [exported.fx, exported.fy], np.ones(4)])
    zero = np.zeros(3)
    raw, _ = cv2.projectPoints(rays, zero, zero, barrel.K, barrel.distortion_array)
    assert ((raw[:, 0] >= -0.5) & (raw[:, 0] <= [barrel.width - 0.5, barrel.height - 0.5])).all()


def test_a_scene_without_landmarks_says_what_to_do(tmp_path: Path) -> None:
    scene = exact_scene()
    bare = replace(scene, views=tuple(View(view.timestamp_s, view.T_world_camera) for view in scene.views))
    with pytest.raises(InputError, match="--export colmap"):
        write_export(ExportRequest(bare, None, ImageMode.NONE), "colmap", tmp_path / "out")


def test_upright_frames_follow_gravity() -> None:
    gravity = np.array([0.1, 0.8, -0.5])
    gravity /= np.linalg.norm(gravity)
    scene = replace(exact_scene(), gravity_w=gravity)
    np.testing.assert_allclose(z_up(scene)[:3, :3] @ gravity, [0, 0, -1], atol=1e-12)
    np.testing.assert_allclose(y_up(scene)[:3, :3] @ gravity, [0, -1, 0], atol=1e-12)
    for T in (z_up(scene), y_up(scene)):
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_nanoseconds_are_those_of_the_decimal() -> None:
    for text in ("1305031453.374112", "0.1", "1403636579.763555527"):
        assert nanoseconds(float(text)) == int((Decimal(repr(float(text))) * 10**9).to_integral_value())
    assert nanoseconds(1305031453.374112) == 1305031453374112000


@pytest.mark.data
@pytest.mark.weights
@pytest.mark.parametrize("name", ["rgbd_dataset_freiburg1_desk", "7scenes_redkitchen_seq-01"])
def test_real_sequences_are_reprojected_within_a_pixel(data_dir: Path, tmp_path: Path, name: str) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    try:
        run = package.run(
            data_dir / name, tmp_path / "run", depth="dinov2", max_frames=60, mesh=False, export=("colmap",)
        )
    except package.WeightsError as error:
        pytest.skip(f"the backbone is not in the cache: {error}")
    model = pycolmap.Reconstruction(run.folder / "export" / "colmap" / "sparse" / "0")
    assert model.compute_mean_reprojection_error() < 1.0
    assert model.num_points3D() > 500
    assert model.num_reg_images() == len(run.reconstruction.keyframes)
    assert min(point.track.length() for point in model.points3D.values()) >= 2
