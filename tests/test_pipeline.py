# SPDX-License-Identifier: Apache-2.0
"""The pipeline's parts on sequences and trackers made up for the purpose."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from slamdepth.config import Config
from slamdepth.errors import CameraError, ConfigError, DatasetError, ImageDecodeError, OutputError
from slamdepth.io import read_tum_trajectory
from slamdepth.pipeline import RunInterrupted, RunOptions, RunProgress, Stage
from slamdepth.pipeline.folder import FILES, RunFolder, run_log, write_log_to
from slamdepth.pipeline.prefetch import FramePrefetcher
from slamdepth.pipeline.results import judge_depth, judge_trajectory, keyframe_trajectory, scale_sentence
from slamdepth.pipeline.run import _settings_text
from slamdepth.pipeline.tracking import Tracked, track
from slamdepth.types import (
    Camera,
    DepthKind,
    DepthPrediction,
    Frame,
    Keyframe,
    Reconstruction,
    StepResult,
    TrackingStatus,
    Trajectory,
)

CAMERA = Camera(8, 6, 10.0, 10.0, 3.5, 2.5)


class MadeUpDataset:
    """Frames numbered by their grey value; some images or depth images do not decode."""

    name = "made-up"
    path = Path("made-up")
    camera = CAMERA
    has_depth = True

    def __init__(self, count: int, broken: tuple[int, ...] = (), broken_depth: tuple[int, ...] = ()) -> None:
        self.timestamps_s = np.arange(count) / 10.0
        self.broken, self.broken_depth = broken, broken_depth
        self.without_depth: tuple[int, ...] = ()
        self.ground_truth: Trajectory | None = None
        self.notes: list[str] = []
        self.wrong_size: int | None = None

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def read(self, index: int, *, with_depth: bool = False) -> Frame:
        if index in self.broken:
            raise ImageDecodeError(f"{index}.png: the image does not decode")
        if index == self.wrong_size:
            raise CameraError(f"{index}.png: the image is 9x9, the camera says 8x6")
        depth_m = None
        if with_depth and index in self.broken_depth:
            raise ImageDecodeError(f"depth/{index}.png: the image does not decode")
        if with_depth and index not in self.without_depth:
            depth_m = np.full((6, 8), 1.0 + index, np.float32)
        image = np.full((6, 8, 3), index % 256, np.uint8)
        return Frame(index, float(self.timestamps_s[index]), image, CAMERA, depth_m)


def pose(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


class MadeUpTracker:
    """Moves 1 m a frame; loses the frames it is told to."""

    def __init__(self, lost: tuple[int, ...] = (), on_step: Callable[[Frame], None] | None = None) -> None:
        self.lost, self.on_step = lost, on_step or (lambda frame: None)
        self.seen: list[int] = []

    def step(self, frame: Frame) -> StepResult:
        self.on_step(frame)
        self.seen.append(frame.index)
        is_lost = frame.index in self.lost
        status = TrackingStatus.LOST if is_lost else TrackingStatus.TRACKING
        return StepResult(frame.index, frame.timestamp_s, status, None if is_lost else pose(frame.index))

    def finish(self) -> Reconstruction:
        placed = [i for i in self.seen if i not in self.lost]
        trajectory = Trajectory(np.array(placed) / 10.0, np.array([pose(i) for i in placed]))
        return Reconstruction(
            trajectory, (), np.zeros((0, 3)), len(self.seen), len(placed), 0, 0, 0, {"tracking": 1.0}
        )


def tracked_of(
    dataset: MadeUpDataset,
    tracker: MadeUpTracker,
    folder: Path,
    *,
    stop: threading.Event | None = None,
    progress: Callable[[RunProgress], None] | None = None,
) -> Tracked:
    return track(
        dataset,
        range(len(dataset)),
        tracker,
        folder / "online.txt",
        with_depth=False,
        progress=progress or (lambda state: None),
        stop=stop or threading.Event(),
    )


# --- frames read ahead ---------------------------------------------------------------


def test_frames_come_in_order_and_with_their_errors() -> None:
    dataset = MadeUpDataset(50, broken=(0, 7, 49))
    with FramePrefetcher(dataset, range(50), with_depth=False) as reader:
        items = list(reader)
    assert [isinstance(item, ImageDecodeError) for item in items] == [i in (0, 7, 49) for i in range(50)]
    assert [item.index for item in items if isinstance(item, Frame)] == [
        i for i in range(50) if i not in (0, 7, 49)
    ]


def test_depth_that_does_not_decode_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    dataset = MadeUpDataset(3, broken_depth=(1,))
    dataset.without_depth = (2,)
    with caplog.at_level(logging.WARNING), FramePrefetcher(dataset, range(3), with_depth=True) as reader:
        frames = [item for item in reader if isinstance(item, Frame)]
        assert reader.broken_depth_images == 1
    assert [frame.depth_m is not None for frame in frames] == [True, False, False]
    assert "depth of frame 1 left out" in caplog.text


def test_leaving_early_ends_the_reader() -> None:
    before = threading.active_count()
    with FramePrefetcher(MadeUpDataset(1000), range(1000), with_depth=False) as reader:
        next(iter(reader))
    assert threading.active_count() == before


def test_only_a_few_frames_are_read_ahead() -> None:
    dataset = MadeUpDataset(1000)
    read: list[int] = []
    original = dataset.read
    dataset.read = lambda index, **keys: (read.append(index), original(index, **keys))[1]  # type: ignore[method-assign]
    with FramePrefetcher(dataset, range(1000), with_depth=False, capacity=3) as reader:
        frames = iter(reader)
        for _ in range(5):
            next(frames)
    assert len(read) <= 5 + 3 + 1


# --- tracking ------------------------------------------------------------------------


def test_every_placed_frame_is_in_the_online_trajectory(tmp_path: Path) -> None:
    tracker = MadeUpTracker(lost=(3, 4))
    tracked = tracked_of(MadeUpDataset(10, broken=(6,)), tracker, tmp_path)
    online, _ = read_tum_trajectory(tmp_path / "online.txt")
    assert online.T_world_camera[:, 0, 3].tolist() == [0, 1, 2, 5, 7, 8, 9]
    assert tracker.seen == [0, 1, 2, 3, 4, 5, 7, 8, 9]
    assert tracked.skipped == 1
    assert not tracked.interrupted
    assert tracked.fps > 0
    assert {"tracking", "finish", "decode"} <= set(tracked.reconstruction.timings_ms)
    assert "1 of 10 images do not decode" in " ".join(tracked.notes)


def test_the_online_trajectory_grows_while_the_run_goes_on(tmp_path: Path) -> None:
    lines: list[int] = []
    tracker = MadeUpTracker(
        on_step=lambda frame: lines.append(len((tmp_path / "online.txt").read_text().splitlines()))
    )
    tracked_of(MadeUpDataset(5), tracker, tmp_path)
    assert lines == [1, 2, 3, 4, 5]  # a heading, and a line for each frame before


def test_a_stop_finishes_with_what_there_is(tmp_path: Path) -> None:
    stop = threading.Event()
    tracker = MadeUpTracker(on_step=lambda frame: stop.set() if frame.index == 4 else None)
    tracked = tracked_of(MadeUpDataset(10), tracker, tmp_path, stop=stop)
    assert tracked.interrupted
    assert tracked.reconstruction.frames == 5
    assert tracked.notes == ("interrupted after 5 of 10 frames",)


def test_a_stop_before_the_first_frame_saves_nothing(tmp_path: Path) -> None:
    stop = threading.Event()
    stop.set()
    with pytest.raises(RunInterrupted, match="before the first frame"):
        tracked_of(MadeUpDataset(10), MadeUpTracker(), tmp_path, stop=stop)


def test_half_of_the_images_may_fail_but_not_more(tmp_path: Path) -> None:
    tracked_of(MadeUpDataset(10, broken=(0, 1, 2, 3, 4)), MadeUpTracker(), tmp_path)
    with pytest.raises(DatasetError, match="more than half of the images do not decode"):
        tracked_of(MadeUpDataset(10, broken=(4, 5, 6, 7, 8, 9)), MadeUpTracker(), tmp_path)


def test_an_image_of_another_size_ends_the_run(tmp_path: Path) -> None:
    dataset = MadeUpDataset(10)
    dataset.wrong_size = 5
    with pytest.raises(CameraError, match=r"5\.png"):
        tracked_of(dataset, MadeUpTracker(), tmp_path)


def test_progress_is_told(tmp_path: Path) -> None:
    states: list[RunProgress] = []
    tracked_of(MadeUpDataset(4, broken=(2,)), MadeUpTracker(), tmp_path, progress=states.append)
    assert [(state.stage, state.done, state.total) for state in states] == [
        (Stage.TRACKING, 0, 4),
        (Stage.TRACKING, 1, 4),
        (Stage.TRACKING, 2, 4),
        (Stage.TRACKING, 4, 4),
        (Stage.OPTIMISING, 4, 4),
    ]


# --- options and settings --------------------------------------------------------------


def test_stride_and_limit_choose_frames() -> None:
    assert list(RunOptions(Path("s")).indices(4)) == [0, 1, 2, 3]
    assert list(RunOptions(Path("s"), stride=3, max_frames=2).indices(10)) == [0, 3]
    assert list(RunOptions(Path("s"), max_frames=99).indices(2)) == [0, 1]


@pytest.mark.parametrize("wrong", [{"stride": 0}, {"max_frames": 0}])
def test_options_out_of_range(wrong: dict[str, int]) -> None:
    with pytest.raises(ConfigError, match="must be 1 or more"):
        RunOptions(Path("s"), **wrong)  # type: ignore[arg-type]


def test_the_settings_file_gives_the_same_settings_again(tmp_path: Path) -> None:
    config = Config.from_dict({"seed": 7, "map": {"voxel_size_m": 0.05}, "odometry": "kiss-icp"})
    (tmp_path / "config.yaml").write_text(_settings_text(RunOptions(Path("s"), max_frames=3), config))
    assert Config.from_yaml(tmp_path / "config.yaml") == config


# --- run folder --------------------------------------------------------------------------


def test_a_default_run_folder_is_always_new(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    paths = set()
    for _ in range(3):
        folder = RunFolder.plan(None, "desk", overwrite=False)
        folder.create()
        assert folder.path.parts[0] == "runs"
        assert folder.path.name.startswith("desk-")
        paths.add(folder.path)
    assert len(paths) == 3


def test_planning_makes_nothing(tmp_path: Path) -> None:
    RunFolder.plan(tmp_path / "a" / "b", "desk", overwrite=False)
    assert not any(tmp_path.iterdir())


def test_an_earlier_run_is_replaced_only_when_asked(tmp_path: Path) -> None:
    place = tmp_path / "run"
    RunFolder.plan(place, "desk", overwrite=False).create()
    (place / "trajectory.txt").write_text("old")
    (place / "mine.txt").write_text("notes")
    with pytest.raises(OutputError, match="--overwrite"):
        RunFolder.plan(place, "desk", overwrite=False)
    RunFolder.plan(place, "desk", overwrite=True).create()
    assert not (place / "trajectory.txt").exists()
    assert (place / "mine.txt").read_text() == "notes"


def test_a_folder_of_something_else_is_never_touched(tmp_path: Path) -> None:
    (tmp_path / "report.json").write_text("another program's")
    with pytest.raises(OutputError, match="holds no earlier run"):
        RunFolder.plan(tmp_path, "desk", overwrite=True)


def test_a_file_is_no_run_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(OutputError, match="file"):
            RunFolder.plan(path, "desk", overwrite=True)


def test_discarding_leaves_what_is_not_ours(tmp_path: Path) -> None:
    for name in ("alone", "shared"):
        folder = RunFolder.plan(tmp_path / name, "desk", overwrite=False)
        folder.create()
        if name == "shared":
            (folder / "mine.txt").write_text("")
        folder.discard()
    assert not (tmp_path / "alone").exists()
    assert [path.name for path in (tmp_path / "shared").iterdir()] == ["mine.txt"]


def test_the_readme_lists_every_file(tmp_path: Path) -> None:
    folder = RunFolder.plan(tmp_path / "run", "desk", overwrite=False)
    folder.create()
    text = (folder / "README.txt").read_text()
    assert all(name in text for name in FILES)


def test_the_log_has_what_was_said_before_there_was_a_folder(tmp_path: Path) -> None:
    package = logging.getLogger("slamdepth")
    level, handlers = package.level, list(package.handlers)
    with run_log() as buffer:
        logging.getLogger("slamdepth.somewhere").debug("before")
        write_log_to(buffer, tmp_path / "log.txt")
        logging.getLogger("slamdepth.somewhere").debug("after")
        assert "after" in (tmp_path / "log.txt").read_text()  # at once: a killed run keeps it
    assert "before" in (tmp_path / "log.txt").read_text()
    assert (package.level, package.handlers) == (level, handlers)


# --- results -----------------------------------------------------------------------------


def keyframe(number: int, scale: float, *, is_sensor: bool = False) -> Keyframe:
    dataset = MadeUpDataset(number + 1)
    depth = np.full((6, 8), (1.0 + number) * scale, np.float32)
    return Keyframe(
        number,
        dataset.read(number),
        pose(number),
        depth,
        None,
        np.zeros((0, 2)),
        1.0,
        DepthPrediction(depth, DepthKind.METRIC, is_sensor=is_sensor),
    )


def test_predicted_depth_is_judged_as_the_model_gave_it() -> None:
    score = judge_depth(MadeUpDataset(5), tuple(keyframe(i, 1.25) for i in (0, 2, 4)))
    assert score is not None
    assert score.frames == 3
    assert score.metric.abs_rel == pytest.approx(0.25, abs=1e-6)
    assert score.sequence_median.abs_rel == pytest.approx(0.0, abs=1e-6)
    assert score.sequence_scale == pytest.approx(0.8, abs=1e-6)


def test_a_sensor_is_not_judged_against_itself() -> None:
    assert judge_depth(MadeUpDataset(1), (keyframe(0, 1.0, is_sensor=True),)) is None


def test_keyframes_whose_depth_is_broken_are_left_out() -> None:
    score = judge_depth(MadeUpDataset(2, broken_depth=(0,)), (keyframe(0, 2.0), keyframe(1, 1.0)))
    assert score is not None
    assert (score.frames, score.metric.abs_rel) == (1, 0.0)


def test_a_trajectory_that_cannot_be_scored_is_a_note() -> None:
    dataset = MadeUpDataset(5)
    still = Trajectory(dataset.timestamps_s, np.tile(np.eye(4), (5, 1, 1)))
    assert judge_trajectory(dataset, still) == (None, ())
    dataset.ground_truth = still
    score, notes = judge_trajectory(dataset, still)
    assert score is None
    assert "not scored" in notes[0]


def test_keyframes_become_a_trajectory() -> None:
    frames = (keyframe(0, 1.0), keyframe(3, 1.0))
    trajectory = Trajectory(np.zeros(0), np.zeros((0, 4, 4)), is_metric=False)
    found = keyframe_trajectory(Reconstruction(trajectory, frames, np.zeros((0, 3)), 0, 0, 0, 0, 0))
    assert found.timestamps_s.tolist() == [0.0, 0.3]
    assert found.T_world_camera[:, 0, 3].tolist() == [0.0, 3.0]
    assert not found.is_metric
    empty = keyframe_trajectory(Reconstruction(trajectory, (), np.zeros((0, 3)), 0, 0, 0, 0, 0))
    assert len(empty) == 0


def test_the_scale_is_told_honestly() -> None:
    class Model:
        name, kind, weights = "net", DepthKind.METRIC, ()

        def predict(self, frame: Frame) -> DepthPrediction:
            raise NotImplementedError

    assert "measured" in scale_sentence(Model(), (keyframe(0, 1.0, is_sensor=True),))
    assert "predicted by net" in scale_sentence(Model(), (keyframe(0, 1.0),))
    Model.kind = DepthKind.AFFINE_INVERSE_DEPTH
    assert "unknown" in scale_sentence(Model(), (keyframe(0, 1.0),))
