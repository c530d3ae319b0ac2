# SPDX-License-Identifier: Apache-2.0
"""A finished map: read from ``RUN/map/``, written there, asked for its parts."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import CameraError, DatasetError, OutputError
from slamdepth.geometry import invert
from slamdepth.io.outputs import writable
from slamdepth.io.tensors import decode_tensors, encode_tensors, read_checked, write_bytes
from slamdepth.io.text import replacing_folder, write_json
from slamdepth.mapstore.format import ABOUT, ARRAYS, FORMAT, OPTIONAL, VERSION, check_arrays, file_of
from slamdepth.types import Camera, Trajectory

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Arrays = Mapping[str, NDArray[Any]]

_FOLDER = "map"


@dataclass(frozen=True)
class Session:
    """A recording that a map was made from.

    Attributes:
        name: of the sequence.
        depth_model: that predicted or measured its depth.
        frames: frames of it that the map places.
    """

    name: str
    depth_model: str
    frames: int = 0


@dataclass(frozen=True)
class Map:
    """A finished map: keyframes, landmarks, words, graph and the frames it places.

    It is plain data, and nothing changes it. A run goes on from a copy.

    Attributes:
        camera: that all keyframes are given in.
        is_measured: a sensor measured the depth it was made with.
        sessions: the recordings, oldest first.
        features: settings of the features (``config.features``).
        metric: how descriptors are compared.
        vocabulary_sha256: of the words that ``places`` counts.
        shutter: readout time and its deviation, seconds; the deviation None where it was not estimated.
        scale: what is known of the scale, as in ``report.json``.
        starts: keyframes that no odometry leads to.
        loop_closures: loops closed.
        groups: every array by file and name, see ``docs/maps.md``.
    """

    camera: Camera
    is_measured: bool
    sessions: tuple[Session, ...]
    features: Mapping[str, Any]
    metric: Mapping[str, Any]
    vocabulary_sha256: str
    shutter: tuple[float, float | None]
    scale: Mapping[str, Any]
    starts: tuple[int, ...]
    loop_closures: int
    groups: Mapping[str, Arrays]

    def __len__(self) -> int:
        """Number of keyframes."""
        return len(self.groups["keyframes"]["timestamp_s"])

    @property
    def T_world_camera(self) -> NDArray[np.float64]:
        """Poses ``(K, 4, 4)`` of the keyframes."""
        return np.asarray(invert(self.groups["keyframes"]["T_camera_world"]))

    @property
    def points_m(self) -> NDArray[np.float64]:
        """Landmarks ``(P, 3)`` that two keyframes or more see, metres, world frame."""
        landmarks = self.groups["landmarks"]
        seen = landmarks["alive"] & (landmarks["observations"] >= 2)
        return np.asarray(landmarks["position_w"][seen])

    @property
    def has_images(self) -> bool:
        """Whether the image of a keyframe was saved."""
        return "images" in self.groups and len(self.groups["images"]["keyframe"]) > 0

    def trajectory(self, session: int = 0) -> Trajectory:
        """Poses of the frames of a recording.

        Args:
            session: its place in :attr:`sessions`.
        """
        frames = self.groups["frames"]
        at = np.flatnonzero(frames["session"] == session)
        at = at[np.argsort(frames["timestamp_s"][at], kind="stable")]
        keyframe = frames["keyframe"][at]
        T_camera_keyframe = frames["T_camera_keyframe"][at].copy()
        growth = self.groups["keyframes"]["unit"][keyframe] / frames["unit"][at]
        T_camera_keyframe[:, :3, 3] *= growth[:, None]
        T_camera_world = T_camera_keyframe @ self.groups["keyframes"]["T_camera_world"][keyframe]
        return Trajectory(frames["timestamp_s"][at], np.asarray(invert(T_camera_world)).reshape(-1, 4, 4))

    @staticmethod
    def load(path: str | Path) -> Map:
        """Read a map.

        Args:
            path: a run folder, or the folder ``map`` in it.

        Raises:
            DatasetError: there is none, a file is missing or damaged, or it has another version; names it.
        """
        folder = map_folder(path)
        about = _read_about(folder)
        groups: dict[str, Arrays] = {}
        for group in ARRAYS:
            file = folder / file_of(group)
            entry = about["files"].get(file.name)
            if entry is None and group in OPTIONAL:
                continue
            if entry is None:
                raise DatasetError(f"{folder / ABOUT}: is damaged: {file.name} is not listed")
            digest = entry.get("sha256") if isinstance(entry, dict) else None
            if not isinstance(digest, str):
                raise DatasetError(f"{folder / ABOUT}: is damaged: {file.name} has no checksum")
            try:
                groups[group], _ = decode_tensors(read_checked(file, digest))
            except ValueError as error:
                raise DatasetError(f"{file}: is damaged: {error}") from error
        sizes = check_arrays(groups, str(folder))
        try:
            saved = _map_of(about, groups)
        except (AttributeError, KeyError, TypeError, ValueError, CameraError) as error:
            raise DatasetError(f"{folder / ABOUT}: is damaged: {error}") from error
        if trouble := _trouble(saved, sizes["K"]):
            raise DatasetError(f"{folder / ABOUT}: is damaged: {trouble}")
        return saved

    def save(self, path: str | Path) -> None:
        """Write the map as a folder, whole or not at all; an earlier map there is replaced.

        Raises:
            OutputError: it cannot be written, or something else is there.
        """
        folder = Path(path)
        writable(folder)
        if folder.exists() and not is_map(folder):
            raise OutputError(f"{folder}: is there already and no map; name another folder")
        with replacing_folder(folder) as partial:
            self._write(partial)

    def _write(self, folder: Path) -> None:
        files = {}
        for group, arrays in self.groups.items():
            data = encode_tensors(arrays)
            files[file_of(group)] = {"bytes": len(data), "sha256": write_bytes(folder / file_of(group), data)}
        counts = {
            "keyframes": len(self),
            "landmarks": len(self.groups["landmarks"]["alive"]),
            "frames": len(self.groups["frames"]["timestamp_s"]),
            "loops": len(self.groups["graph"]["loop_units"]),
        }
        write_json(
            folder / ABOUT,
            {
                "format": FORMAT,
                "version": VERSION,
                "counts": counts,
                "camera": asdict(self.camera),
                "is_measured": self.is_measured,
                "sessions": [asdict(session) for session in self.sessions],
                "features": dict(self.features),
                "metric": dict(self.metric),
                "vocabulary_sha256": self.vocabulary_sha256,
                "shutter": {"readout_s": self.shutter[0], "sigma_s": self.shutter[1]},
                "scale": dict(self.scale),
                "starts": list(self.starts),
                "loop_closures": self.loop_closures,
                "files": files,
            },
        )

    def without_images(self) -> Map:
        """The same map without its images."""
        return replace(self, groups={name: one for name, one in self.groups.items() if name != "images"})


def is_map(folder: Path) -> bool:
    """Whether a folder holds a map, sound or not."""
    return (folder / ABOUT).is_file()


def remove_map(folder: Path) -> None:
    """Remove the files of a map, and its folder where nothing else is in it; never through a link.

    Raises:
        OSError: a file cannot be removed.
    """
    if folder.is_symlink() or not is_map(folder):
        return
    for group in ARRAYS:
        (folder / file_of(group)).unlink(missing_ok=True)
    (folder / ABOUT).unlink()
    if not any(folder.iterdir()):
        folder.rmdir()


def map_folder(path: str | Path) -> Path:
    """The folder of the map that ``path``, a run folder or the map's own, means.

    Raises:
        DatasetError: there is none.
    """
    place = Path(path).expanduser()
    for folder in (place, place / _FOLDER):
        if is_map(folder):
            return folder
    if not place.exists():
        raise DatasetError(f"{place}: no such folder; name a run folder with a map, or the map itself")
    raise DatasetError(f"{place}: holds no map ({_FOLDER}/{ABOUT}); runs with features write one")


def _read_about(folder: Path) -> dict[str, Any]:
    path = folder / ABOUT
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DatasetError(f"{path}: cannot be read: {error.strerror or error}") from error
    except (ValueError, RecursionError) as error:  # RecursionError: too deeply nested
        raise DatasetError(f"{path}: is damaged: {error}") from error
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise DatasetError(f"{path}: is no map of slamdepth")
    version = about.get("version")
    if version != VERSION:
        raise DatasetError(
            f"{path}: has version {version} of the format, and this slamdepth reads version {VERSION}: make "
            "the map again from its recording, or use the version that wrote it"
        )
    if not isinstance(about.get("files"), dict):
        raise DatasetError(f"{path}: is damaged: it lists no files")
    return about


def _map_of(about: dict[str, Any], groups: Mapping[str, Arrays]) -> Map:
    camera: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in about["camera"].items()
    }
    shutter = about["shutter"]
    return Map(
        Camera(**camera),
        bool(about["is_measured"]),
        tuple(Session(**session) for session in about["sessions"]),
        dict(about["features"]),
        dict(about["metric"]),
        str(about["vocabulary_sha256"]),
        (float(shutter["readout_s"]), None if shutter["sigma_s"] is None else float(shutter["sigma_s"])),
        dict(about["scale"]),
        tuple(int(k) for k in about["starts"]),
        int(about["loop_closures"]),
        groups,
    )


def _trouble(saved: Map, keyframes: int) -> str:
    """What is wrong with the numbers of ``map.json``; empty where nothing is."""
    if not all(0 <= start < keyframes for start in saved.starts):
        return "starts points nowhere"
    for group in ("keyframes", "frames"):
        session = saved.groups[group]["session"]
        if session.size and (session.min() < 0 or session.max() >= len(saved.sessions)):
            return f"{file_of(group)} has a recording that sessions does not list"
    if any(value is not None and np.isnan(value) for value in saved.shutter):
        return "shutter is no time"
    return ""
