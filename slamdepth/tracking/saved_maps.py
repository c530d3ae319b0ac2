# SPDX-License-Identifier: Apache-2.0
"""Maps that were saved: what a tracker leaves, and what it goes on from."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slamdepth.config import Config, FeatureConfig
from slamdepth.errors import CameraError, DatasetError
from slamdepth.geometry import backproject
from slamdepth.loops.edges import edge_arrays, loop_arrays, loops_of, odometry_edges
from slamdepth.loops.vocabulary import Vocabulary
from slamdepth.mapping.keyframe_store import StoredFrame
from slamdepth.mapping.map_view import MapView
from slamdepth.mapstore import Map as SavedMap
from slamdepth.mapstore import Session
from slamdepth.tracking.map_arrays import (
    keyframe_arrays,
    keyframe_states,
    landmark_arrays,
    landmarks_of,
    metric_of,
    metric_state,
)
from slamdepth.tracking.map_parts import MapParts
from slamdepth.tracking.past_frames import PastFrames
from slamdepth.types import Camera
from slamdepth.typing import Floats

_SAME = ("name", "levels", "scale_factor")
"""Settings of features that have to be those of the map."""
_SAME_PX = 1e-6  # far below what any camera is known to, far above rounding


@dataclass(frozen=True)
class MapInfo:
    """What a saved map says beyond what the tracker knows.

    Attributes:
        session: the recording that was tracked.
        scale: what is known of the scale, as in ``report.json``.
        with_images: keep the keyframes' images.
    """

    session: Session
    scale: Mapping[str, Any]
    with_images: bool = False


def save_map(
    tracked: MapParts,
    camera: Camera,
    features: FeatureConfig,
    earlier: Sequence[Session],
    kept_s: Collection[float],
    info: MapInfo,
) -> SavedMap:
    """A finished map as plain data. Ids of landmarks that are gone are given away first.

    Args:
        camera: of the run.
        features: settings of the run.
        earlier: recordings that the map was made of before.
        kept_s: times of the frames that have a pose in the result.
    """
    past = PastFrames()
    past.absorb(tracked.past)
    for timestamp_s, pose in tracked.frames.poses:
        if timestamp_s in kept_s:
            past.add(timestamp_s, tracked.map.session, pose)
    session = replace(info.session, frames=past.count(tracked.map.session))
    return _saved(tracked, camera, features.model_dump(), (*earlier, session), past, info)


def save_merged(tracked: MapParts, first: SavedMap, sessions: Sequence[Session]) -> SavedMap:
    """Maps that were loaded and joined as plain data.

    Args:
        first: the one whose camera, features and scale the joined one has.
        sessions: of all.
    """
    info = MapInfo(sessions[0], first.scale)
    return _saved(tracked, first.camera, first.features, sessions, tracked.past, info)


def _saved(
    tracked: MapParts,
    camera: Camera,
    features: Mapping[str, Any],
    sessions: Sequence[Session],
    past: PastFrames,
    info: MapInfo,
) -> SavedMap:
    map_ = tracked.map
    map_.compact(at_once=True)
    loops = tracked.integration.loops
    gravity = tracked.integration.gravity.state()
    groups: dict[str, Mapping[str, NDArray[Any]]] = {
        "keyframes": keyframe_arrays(map_.keyframes),
        "landmarks": landmark_arrays(map_.landmarks),
        "places": loops.places.state(),
        "graph": {
            **{f"loop_{name}": array for name, array in loop_arrays(loops.measured).items()},
            **_odometry(map_),
            "gravity_w": gravity["gravity_w"],
            "gravity_confidence": gravity["confidence"],
        },
        "frames": past.arrays(),
    }
    if info.with_images:
        groups["images"] = _images(map_)
    return SavedMap(
        camera=camera,
        is_measured=map_.is_measured,
        sessions=tuple(sessions),
        features=dict(features),
        metric=metric_state(map_.keyframes[0].features.metric),
        vocabulary_sha256=vocabulary_sha256(loops.places.vocabulary),
        shutter=(tracked.shutter.readout_s, tracked.shutter.sigma_s),
        scale=info.scale,
        starts=tuple(sorted(start for start in map_.starts if start < len(map_.keyframes))),
        loop_closures=loops.count,
        groups=groups,
    )


def _odometry(map_: MapView) -> dict[str, NDArray[Any]]:
    arrays = edge_arrays(odometry_edges(map_, map_.covisibility()))
    return {f"odometry_{name}": arrays[name] for name in ("keyframes", "T_i_j", "sigmas")}


def _images(map_: MapView) -> dict[str, NDArray[Any]]:
    kept = [keyframe for keyframe in map_.keyframes if keyframe.frame.is_kept]
    files = [keyframe.frame.image_bytes() for keyframe in kept]
    return {
        "keyframe": np.array([keyframe.id for keyframe in kept], dtype=np.int64),
        "first_byte": np.concatenate([[0], np.cumsum([len(file) for file in files])]).astype(np.int64),
        "jpeg": np.frombuffer(b"".join(files), dtype=np.uint8),
    }


def load_map(saved: SavedMap, into: MapParts, camera: Camera, features: FeatureConfig) -> None:
    """Fill the parts of an empty map with a saved one. The camera is lost in it.

    Args:
        camera: of the frames to come.
        features: settings of the run to come.

    Raises:
        DatasetError: the map was made with other features or other words.
        CameraError: its keyframes cannot be shown to the camera.
    """
    check_features(saved, features)
    words = into.integration.loops.places.vocabulary
    if saved.vocabulary_sha256 != vocabulary_sha256(words):
        raise DatasetError(
            "the map was made with other words, so its places cannot be recognised; make it again"
        )
    arrays = saved.groups["keyframes"]
    is_same = same_lens(saved.camera, camera)
    if not is_same:
        arrays = _seen_by(arrays, saved.camera, camera)
    images, session = _images_for(camera, saved), arrays["session"].tolist()

    def frame_of(number: int, index: int, timestamp_s: float, gravity: Floats | None) -> StoredFrame:
        jpeg = images.get((session[number], index))
        return StoredFrame.of_saved(index, timestamp_s, camera, gravity, jpeg=jpeg)

    states = keyframe_states(arrays, metric_of(saved.metric), frame_of, lambda number, stored: None)
    first_of_run = len(states)
    into.map.restore(states, landmarks_of(saved.groups["landmarks"]), {*saved.starts, first_of_run})
    into.map.session = len(saved.sessions)
    graph = saved.groups["graph"]
    measured = {
        name.removeprefix("loop_"): array for name, array in graph.items() if name.startswith("loop_")
    }
    into.integration.loops.load(saved.groups["places"], loops_of(measured), saved.loop_closures)
    into.integration.gravity.restore(
        {"gravity_w": graph["gravity_w"], "confidence": graph["gravity_confidence"], "queries": 0}
    )
    if is_same:
        into.shutter.go_on_from(*saved.shutter, first_of_run)
    into.past.restore(saved.groups["frames"], into.map.keyframes)
    into.is_loaded = True


def _images_for(camera: Camera, saved: SavedMap) -> dict[tuple[int, int], bytes]:
    """The JPEGs that a map has, by recording and frame; none where ``camera`` has another lens."""
    if not saved.has_images or not same_lens(saved.camera, camera):
        return {}
    images, keyframes = saved.groups["images"], saved.groups["keyframes"]
    first = images["first_byte"].tolist()
    session, frame = keyframes["session"].tolist(), keyframes["frame"].tolist()
    return {
        (session[k], frame[k]): images["jpeg"][first[n] : first[n + 1]].tobytes()
        for n, k in enumerate(images["keyframe"].tolist())
    }


def with_features_of(saved: SavedMap, config: Config | None) -> Config:
    """The settings ``config`` or the defaults, with features like those of the map.

    Raises:
        ConfigError: the map's are not known here.
    """
    asked = (config or Config()).model_dump()
    return Config.from_dict({**asked, "features": dict(saved.features)}, origin="the map")


def check_features(saved: SavedMap, features: FeatureConfig) -> None:
    """Refuse features that the map's cannot be compared with.

    Raises:
        DatasetError: a setting differs; names it.
    """
    asked = features.model_dump()
    for name in _SAME:
        if asked[name] != saved.features.get(name):
            raise DatasetError(
                f"the map was made with features.{name} {saved.features.get(name)}, and this run asks for "
                f"{asked[name]}: give the run the map's features"
            )


def same_lens(a: Camera, b: Camera) -> bool:
    """Whether two cameras show the same world in the same pixels, but for rounding where one was scaled."""
    off_px = np.abs([a.fx - b.fx, a.fy - b.fy, a.cx - b.cx, a.cy - b.cy])
    a = replace(a, fx=b.fx, fy=b.fy, cx=b.cx, cy=b.cy, fps=b.fps, depth_factor=b.depth_factor)
    return a == b and bool((off_px < _SAME_PX).all())


def vocabulary_sha256(vocabulary: Vocabulary) -> str:
    """Digest of the words and their weights."""
    return hashlib.sha256(vocabulary.words.tobytes() + vocabulary.idf.tobytes()).hexdigest()


def _seen_by(arrays: Mapping[str, NDArray[Any]], theirs: Camera, camera: Camera) -> dict[str, NDArray[Any]]:
    """Keyframes as another camera would have taken them: the rays stay, their pixels change.

    What the shutter moved is taken out for good, as another camera has another shutter.
    """
    import cv2

    pinhole, own = theirs.without_distortion(), camera.without_distortion()
    px = arrays["px"]
    rays = backproject(pinhole, px, np.ones(len(px)))
    if len(px) == 0:
        return dict(arrays)
    now = rays[:, :2] * (own.fx, own.fy) + (own.cx, own.cy)
    raw, _ = cv2.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), camera.K, camera.distortion_array)
    raw_px = np.asarray(raw, dtype=np.float64).reshape(-1, 2)
    if not np.isfinite(raw_px).all():
        raise CameraError("the lens of this camera does not show what the map's camera saw")
    return {
        **arrays,
        "px": np.asarray(now, dtype=np.float64),
        "raw_px": raw_px,
        "sigma_px": arrays["sigma_px"] * (own.fx / pinhole.fx),
        "velocity": np.zeros_like(arrays["velocity"]),
    }
