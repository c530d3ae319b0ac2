# SPDX-License-Identifier: Apache-2.0
"""The benchmark of place recognition: who shows the same place, and what answers are worth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from benchmarks import places
from benchmarks.places_methods import vectors
from benchmarks.places_scores import score_answers
from benchmarks.places_truth import labels, overlaps
from slamdepth.errors import WeightsError
from slamdepth.types import Camera

CAMERA = Camera(320, 240, 320.0, 320.0, 159.5, 119.5)


def moved(*offsets_m: float) -> np.ndarray:
    """Cameras side by side, all looking ahead."""
    T = np.tile(np.eye(4), (len(offsets_m), 1, 1))
    T[:, 0, 3] = offsets_m
    return T


def test_overlap_of_a_wall_is_what_both_see_of_it() -> None:
    wall = np.full((240, 320), 2.0, np.float32)  # 2 m wide in view
    found = overlaps(CAMERA, [wall] * 4, moved(0.0, 0.5, 1.0, 5.0), tolerance=0.1)
    np.testing.assert_allclose(found[0], [1.0, 0.75, 0.5, 0.0], atol=0.03)
    np.testing.assert_allclose(found, found.T)


def test_what_is_hidden_is_not_seen() -> None:
    wall, box = np.full((240, 320), 2.0, np.float32), np.full((240, 320), 1.0, np.float32)
    from_wall_to_box = overlaps(CAMERA, [wall, box], moved(0.0, 0.0), tolerance=0.1)[0, 1]
    assert from_wall_to_box == pytest.approx(0.5)  # the box's points are seen where the wall was, not back
    unknown = np.zeros((240, 320), np.float32)
    assert overlaps(CAMERA, [wall, unknown], moved(0.0, 0.0), tolerance=0.1)[0, 1] == pytest.approx(0.5)


def test_labels_leave_a_band_between() -> None:
    np.testing.assert_array_equal(labels(np.array([[0.31, 0.3, 0.29, 0.05, 0.049]])), [[1, 1, -1, -1, 0]])


def test_precision_and_recall_of_answers_written_down() -> None:
    truth = np.zeros((8, 8), dtype=np.int8)
    truth[4, 0] = truth[5, 1] = truth[6, 2] = 1
    truth[4, 3] = -1
    earlier = {q: [0, 1, 2, 3] for q in (4, 5, 6, 7)}
    answers = {
        4: [(3, 0.95), (0, 0.9)],  # the first counts neither way
        5: [(0, 0.7), (1, 0.6)],  # wrong, then right
        6: [(2, 0.5)],
        7: [(1, 0.8)],  # never seen before
    }
    score = score_answers(answers, truth, earlier)
    assert (score.queries, score.known) == (4, 3)
    np.testing.assert_allclose(score.curve, [[1 / 3, 1], [1 / 3, 1 / 2], [1 / 3, 1 / 3], [2 / 3, 1 / 2]])
    assert score.recall_at_full_precision == pytest.approx(1 / 3)
    assert score.average_precision == pytest.approx(1 / 3 * 1 + 1 / 3 * 1 / 2)
    assert score.recall_at_1 == pytest.approx(2 / 3)
    assert score.recall_at_5 == 1.0


def test_equal_scores_are_accepted_together_and_silence_is_not_wrong() -> None:
    truth = np.zeros((4, 4), dtype=np.int8)
    truth[2, 0] = truth[3, 0] = 1
    score = score_answers({2: [(0, 0.5)], 3: [(1, 0.5)]}, truth, {2: [0, 1], 3: [0, 1]})
    np.testing.assert_allclose(score.curve, [[0.5, 0.5]])
    assert score.recall_at_full_precision == 0.0
    silent = score_answers({2: [], 3: [(0, 1.0)]}, truth, {2: [0, 1], 3: [0, 1]})
    assert (silent.recall_at_full_precision, silent.recall_at_1) == (0.5, 0.5)
    nothing = score_answers({2: [], 3: []}, truth, {2: [0, 1], 3: [0, 1]})
    assert (nothing.average_precision, nothing.recall_at_full_precision) == (0.0, 0.0)


def test_only_frames_old_enough_are_asked_for() -> None:
    assert places.earlier_frames([0.0, 1.0, 2.5, 3.0], 2.0) == {2: [0], 3: [0, 1]}


def test_vectors_answer_by_their_cosine() -> None:
    answer = vectors([np.array(v, np.float32) for v in ([1, 0], [0, 3], [1, 1], [2, 0.1])])
    assert [k for k, _ in answer(3, [0, 1, 2])] == [0, 2, 1]


def test_the_command_writes_table_curves_and_plot(
    tiny_room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def absent(path: object = None) -> Path:
        raise WeightsError("no backbone")

    monkeypatch.setattr("slamdepth.depth.weights.find_backbone", absent)
    output = tmp_path / "places.json"
    command = ["--data", str(tiny_room.parent), "--stride", "4", "--apart", "0.5", "--output", str(output)]
    assert places.main(command) == 0
    printed = capsys.readouterr()
    assert "without DINOv2's rows: no backbone" in printed.err
    made = json.loads(output.read_text())
    assert [row["method"] for row in made["rows"]] == ["bag of ORB words", "bag, verified as by the tracker"]
    for row in made["rows"]:
        assert row["overlap_from"] == "sensor depth"
        assert row["figures"]["known"] > 0
        assert row["figures"]["recall_at_1"] > 0.5  # a slow sweep and back
    assert output.with_suffix(".md").read_text().strip() == printed.out.strip()
    assert output.with_suffix(".svg").stat().st_size > 1000


def test_wrong_requests_are_one_line(tiny_room: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--data", str(tiny_room.parent)]
    for more, message in (
        (["--stride", "0"], "--stride must be at least 1"),
        (["--sequences", "absent"], "absent"),
    ):
        assert places.main([*data, *more]) != 0
        assert message in capsys.readouterr().err
