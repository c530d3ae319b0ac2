# SPDX-License-Identifier: Apache-2.0
"""A second start for an adjustment: cameras that see much re-register those that see little."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from tracking_scene import ConstantDepth, Run, colour_only, frames

from slamdepth.backend.bundle import bundle_adjust
from slamdepth.backend.bundle_problem import BundleProblem
from slamdepth.backend.resection import multi_start
from slamdepth.config import Config
from slamdepth.geometry import invert, project, rotation_angle_rad, se3_exp, transform
from slamdepth.mapping.map import Map
from slamdepth.tracking import adjuster
from slamdepth.tracking.adjuster import Adjuster
from slamdepth.tracking.rolling_shutter import RollingShutter
from slamdepth.tracking.view_change import ViewChange
from slamdepth.tracking.workers import Worker
from slamdepth.types import Camera, Frame

CAMERA = Camera(640, 480, 520.0, 510.0, 319.0, 241.0)
WEAK = 5  # the first cameras, which see little
COUNT = 14


def truth(seed: int = 0) -> BundleProblem:
    """Cameras in a row, the first fixed: five see 40 points of a cloud, the others some 300."""
    rng = np.random.default_rng(seed)
    X = rng.uniform((-1.6, -1.0, 2.0), (3.2, 1.0, 4.0), (900, 3))
    step = np.array([-0.12, 0.01, 0.0, 0.0, -0.01, 0.0])
    T = np.stack([se3_exp(k * step) for k in range(COUNT)])
    few = np.zeros(len(X), dtype=bool)
    few[rng.permutation(len(X))[:120]] = True
    parts: list[tuple[int, np.ndarray, np.ndarray]] = []
    for k in range(COUNT):
        px, z = project(CAMERA, transform(T[k], X))
        inside = (z > 0.1) & (px > 0).all(axis=1) & (px < (640, 480)).all(axis=1)
        seen = np.flatnonzero(inside & (few if k < WEAK else True))
        parts.append((k, seen, px[seen]))
    m = sum(len(seen) for _, seen, _ in parts)
    return BundleProblem(
        camera=CAMERA,
        T_camera_world=T,
        fixed=np.arange(COUNT) == 0,
        points_w=X,
        obs_camera=np.concatenate([np.full(len(seen), k) for k, seen, _ in parts]),
        obs_point=np.concatenate([seen for _, seen, _ in parts]),
        px=np.concatenate([px for _, _, px in parts]),
        sigma_px=np.ones(m),
        log_depth=np.full(m, np.nan),
        sigma_log=np.full(m, 0.1),
    )


def wrongly_started(exact: BundleProblem, degrees: float = 15.0) -> BundleProblem:
    """The weak cameras turned and shifted against the rest, as after a wrong start of the map.

    The first camera stays, so all others and the points are displaced.
    """
    T = exact.T_camera_world.copy()
    wrong = se3_exp(np.array([0.2, 0.0, 0.3, 0.0, np.deg2rad(degrees), 0.0]))
    for k in range(WEAK, COUNT):
        T[k] = T[k] @ wrong
    return replace(exact, T_camera_world=T, points_w=transform(invert(wrong), exact.points_w))


def errors(T: np.ndarray, T_true: np.ndarray) -> np.ndarray:
    """Of each camera seen from the first one: the larger of radians and of metres, once scales agree."""
    relative, true = T @ invert(T[0]), T_true @ invert(T_true[0])
    factor = np.linalg.norm(true[-1, :3, 3]) / np.linalg.norm(relative[-1, :3, 3])
    D = relative.copy()
    D[:, :3, 3] *= factor
    D = D @ invert(true)
    return np.asarray(np.maximum(rotation_angle_rad(D[:, :3, :3]), np.linalg.norm(D[:, :3, 3], axis=1)))


def test_cameras_that_see_little_are_re_registered() -> None:
    exact = truth()
    wrong = wrongly_started(exact)
    assert errors(wrong.T_camera_world, exact.T_camera_world).max() > 0.2
    found = multi_start(wrong)
    assert found is not None
    assert errors(found.T_camera_world, exact.T_camera_world).max() < 1e-3
    np.testing.assert_array_equal(found.T_camera_world[0], wrong.T_camera_world[0])  # the fixed one
    # points moved along: nothing is left to adjust
    seen = np.unique(exact.obs_point)
    assert bundle_adjust(found, (1,)).initial_cost < 1e-2 * len(seen)


def test_a_good_start_is_kept() -> None:
    exact = truth()
    assert multi_start(exact) is None
    noise = np.random.default_rng(1).normal(0, 0.5, exact.px.shape)
    assert multi_start(replace(exact, px=exact.px + noise)) is None


def test_cameras_that_all_see_much_need_no_other_start() -> None:
    exact = wrongly_started(truth())
    strong = exact.obs_camera >= WEAK
    only = replace(
        exact,
        T_camera_world=exact.T_camera_world[WEAK:],
        fixed=np.arange(COUNT - WEAK) == 0,
        obs_camera=exact.obs_camera[strong] - WEAK,
        obs_point=exact.obs_point[strong],
        px=exact.px[strong],
        sigma_px=exact.sigma_px[strong],
        log_depth=exact.log_depth[strong],
        sigma_log=exact.sigma_log[strong],
    )
    assert multi_start(only) is None


def test_a_camera_that_cannot_be_registered_moves_with_its_neighbour() -> None:
    wrong = wrongly_started(truth())
    lonely = wrong.obs_camera != 2
    keep = lonely | (np.cumsum(~lonely) <= 8)  # eight observations are left to camera 2
    few = replace(
        wrong,
        obs_camera=wrong.obs_camera[keep],
        obs_point=wrong.obs_point[keep],
        px=wrong.px[keep],
        sigma_px=wrong.sigma_px[keep],
        log_depth=wrong.log_depth[keep],
        sigma_log=wrong.sigma_log[keep],
    )
    found = multi_start(few)
    assert found is not None
    was = few.T_camera_world[2] @ invert(few.T_camera_world[1])
    now = found.T_camera_world[2] @ invert(found.T_camera_world[1])
    np.testing.assert_allclose(now, was, atol=1e-9)


def test_wrong_matches_do_not_register_a_camera() -> None:
    exact = truth()
    wrong = wrongly_started(exact)
    rng = np.random.default_rng(2)
    mine = np.flatnonzero(wrong.obs_camera == 3)
    px = wrong.px.copy()
    px[mine] = rng.uniform((0, 0), (640, 480), (len(mine), 2))
    found = multi_start(replace(wrong, px=px))
    assert found is not None
    others = np.arange(COUNT) != 3
    assert errors(found.T_camera_world, exact.T_camera_world)[others].max() < 1e-3


@pytest.mark.parametrize("seed", range(3))
def test_the_same_problem_gives_the_same_start(seed: int) -> None:
    wrong = wrongly_started(truth(seed))
    one, other = multi_start(wrong), multi_start(wrong)
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.T_camera_world, other.T_camera_world)
    np.testing.assert_array_equal(one.points_w, other.points_w)


def test_nothing_to_register() -> None:
    exact = truth()
    nothing = np.zeros(0, dtype=np.int64)
    empty = replace(
        exact,
        obs_camera=nothing,
        obs_point=nothing,
        px=np.zeros((0, 2)),
        sigma_px=np.zeros(0),
        log_depth=np.zeros(0),
        sigma_log=np.zeros(0),
    )
    assert multi_start(empty) is None


@dataclass
class Seen:
    px: np.ndarray
    sigma_px: np.ndarray
    descriptors: np.ndarray
    octave: np.ndarray


def map_of(problem: BundleProblem) -> Map:
    map_ = Map()
    id_of = np.full(len(problem.points_w), -1, dtype=np.int64)
    for k, T in enumerate(problem.T_camera_world):
        at = np.flatnonzero(problem.obs_camera == k)
        n, point = len(at), problem.obs_point[at]
        features = Seen(problem.px[at], np.ones(n), np.zeros((n, 32), np.uint8), np.zeros(n, np.int64))
        frame = Frame(k, k / 30, np.zeros((480, 640, 3), np.uint8), CAMERA)
        known = id_of[point]
        keyframe = map_.add_keyframe(frame, features, T, known)
        new = np.flatnonzero(known < 0)
        id_of[point[new]] = map_.create_landmarks(
            keyframe, new, problem.points_w[point[new]], np.tile(np.eye(3), (len(new), 1, 1))
        )
    return map_


def adjusted_from_two_starts(problem: BundleProblem) -> tuple[bool, np.ndarray]:
    map_, config = map_of(problem), Config()
    side = Worker("side")
    two_starts = Adjuster(
        CAMERA, config, map_, RollingShutter(CAMERA, config.shutter, map_), ViewChange(map_), side
    )
    is_better = two_starts.adjust_from_two_starts(list(range(COUNT)), map_.seen_by(2), (5, 5))
    side.close()
    return is_better, np.stack([k.T_camera_world for k in map_.keyframes])


def test_the_map_takes_over_what_fits_better() -> None:
    exact = truth()
    is_better, T = adjusted_from_two_starts(wrongly_started(exact))
    assert is_better
    assert errors(T, exact.T_camera_world).max() < 1e-3


def test_the_map_keeps_what_fits_as_well() -> None:
    exact = truth()
    is_better, T = adjusted_from_two_starts(exact)
    assert not is_better
    np.testing.assert_array_equal(T, exact.T_camera_world)


def test_another_start_that_ends_no_better_is_not_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    exact = truth()
    monkeypatch.setattr(adjuster, "multi_start", lambda problem: wrongly_started(problem, 2.0))
    is_better, T = adjusted_from_two_starts(exact)
    assert not is_better
    np.testing.assert_array_equal(T, exact.T_camera_world)


def test_another_start_is_noted_and_only_tried_with_predicted_depth(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[int] = []

    def adjust_from_two_starts(self: Adjuster, window: list[int], *rest: object) -> bool:
        tried.append(len(window))
        return True

    monkeypatch.setattr(Adjuster, "adjust_from_two_starts", adjust_from_two_starts)
    given = frames(range(24), change=colour_only)
    notes = Run(given, ConstantDepth()).finish().notes
    assert len(tried) == 1
    assert any("re-registered" in note for note in notes)
    assert not any("re-registered" in note for note in Run(frames(range(24))).finish().notes)
    assert len(tried) == 1
