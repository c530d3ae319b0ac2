# SPDX-License-Identifier: Apache-2.0
"""The pipeline's parts on sequences and trackers made up for the purpose."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from made_up import MadeUpDataset, MadeUpTracker

from slamdepth.config import Config
from slamdepth.errors import CameraError, ConfigError, DatasetError, ImageDecodeError
from slamdepth.io import read_tum_trajectory
from slamdepth.pipeline import RunInterrupted, RunOptions, RunProgress, RunStage, tracking
from slamdepth.pipeline.asked import settings_text
from slamdepth.pipeline.prefetch import FramePrefetcher, ReadFrame
from slamdepth.pipeline.tracking import Tracked, track
from slamdepth.types import Frame


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
    assert [item.frame.index for item in items if isinstance(item, ReadFrame)] == [
        i for i in range(50) if i not in (0, 7, 49)
    ]


def test_depth_that_does_not_decode_is_left_out(caplog: pytest.LogCaptureFixture) -> None:
    dataset = MadeUpDataset(3, broken_depth=(1,))
    dataset.without_depth = (2,)
    with caplog.at_level(logging.WARNING), FramePrefetcher(dataset, range(3), with_depth=True) as reader:
        frames = [item.frame for item in reader if isinstance(item, ReadFrame)]
        assert reader.broken_depth_images == 1
    assert [frame.depth_m is not None for frame in frames] == [True, False, False]
    assert "depth of frame 1 left out" in caplog.text


def test_leaving_early_ends_the_reader() -> None:
    before = threading.active_count()
    with FramePrefetcher(MadeUpDataset(1000), range(1000), with_depth=False) as reader:
        next(iter(reader))
    assert threading.active_count() == before


def test_only_a_few_frames_are_read_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = MadeUpDataset(1000)
    read: list[int] = []
    original = dataset.read

    def listed(index: int, *, with_depth: bool = False) -> Frame:
        read.append(index)
        return original(index, with_depth=with_depth)

    monkeypatch.setattr(dataset, "read", listed)
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
    assert {"tracking", "finish", "decode"} <= set(tracked.reconstruction.statistics.timings_ms)
    calls = tracked.reconstruction.statistics.timing_calls
    assert (calls["finish"], calls["decode"]) == (1, len(tracked.steps))
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
    assert tracked.reconstruction.statistics.frames == 5
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


def test_progress_is_reported(tmp_path: Path) -> None:
    states: list[RunProgress] = []
    tracked_of(MadeUpDataset(4, broken=(2,)), MadeUpTracker(), tmp_path, progress=states.append)
    assert [(state.stage, state.done, state.total) for state in states] == [
        (RunStage.TRACKING, 0, 4),
        (RunStage.TRACKING, 1, 4),
        (RunStage.TRACKING, 2, 4),
        (RunStage.TRACKING, 4, 4),
        (RunStage.OPTIMISING, 4, 4),
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
    (tmp_path / "config.yaml").write_text(settings_text(RunOptions(Path("s"), max_frames=3), config))
    assert Config.from_yaml(tmp_path / "config.yaml") == config


@pytest.mark.parametrize(("broken", "messages"), [(5, 0), (6, 1), (9, 1)])
def test_counting_is_announced_only_where_more_images_follow(
    broken: int, messages: int, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "slamdepth"):
        for number in range(1, broken + 1):
            tracking._warn(ImageDecodeError(f"{number}.png: cannot be read"), number)
    assert caplog.text.count("are only counted") == messages
    assert caplog.text.count("image skipped: ") == min(broken, 5)
