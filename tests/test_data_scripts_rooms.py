# SPDX-License-Identifier: Apache-2.0
"""The rooms that training views are rendered of."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"
sys.path.insert(0, str(SCRIPTS))

from training_rooms import plain_scene, varied_scene  # noqa: E402

from slamdepth.datasets.synth_shapes import Surface  # noqa: E402

SMALL = ["--rooms", "1", "--views", "3", "--first-seed", "5000"]


def rendered(folder: Path, *more: str) -> list[Path]:
    script = str(SCRIPTS / "render_training_rooms.py")
    subprocess.run([sys.executable, script, str(folder), *SMALL, *more], check=True, capture_output=True)
    return sorted(folder.glob("*.jpg"))


@pytest.mark.parametrize("seed", [3, 5001])
def test_a_plain_room_is_the_varied_one_painted_anew(seed: int) -> None:
    varied, plain = varied_scene(seed).surfaces, plain_scene(seed).surfaces
    assert len(plain) == len(varied)
    for one, other in zip(varied, plain, strict=True):
        np.testing.assert_array_equal(one.points, other.points)
        assert one.emission == other.emission

    def texture(surface: Surface) -> np.ndarray:
        return surface.paint(np.random.default_rng(0), 40, 40, 0.01)

    glowing = [k for k, surface in enumerate(varied) if surface.emission > 0]
    assert glowing
    for k in glowing:
        np.testing.assert_array_equal(texture(plain[k]), texture(varied[k]))
    wall = max(range(1, len(varied)), key=lambda k: float(np.ptp(varied[k].points.reshape(-1, 3)[:, 2])))
    assert texture(plain[wall]).std(axis=(0, 1)).max() < 0.05


def test_views_are_pairs_and_come_out_the_same_again(tmp_path: Path) -> None:
    first, again = rendered(tmp_path / "a", "--plain"), rendered(tmp_path / "b", "--plain")
    assert [p.name for p in first] == ["00000.jpg", "00001.jpg", "00002.jpg"]
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]
    about = json.loads((tmp_path / "a" / "camera.json").read_text(encoding="utf-8"))
    for image in first:
        depth = cv2.imread(str(image.with_suffix(".png")), cv2.IMREAD_UNCHANGED)
        assert depth.shape == (about["height"], about["width"])
        assert np.percentile(depth, 95) > 1.2 * np.percentile(depth, 5)  # not a piece of wall
