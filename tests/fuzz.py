# SPDX-License-Identifier: Apache-2.0
"""Damaged input for every reader and parser: ``make fuzz``, or ``python tests/fuzz.py --cases 500 --seed 1``.

A case takes a good recording or file, damages it at random, and reads all of it. It must end in a
``SlamdepthError`` of one line or in a sound result. Anything else (another error, more than one line, a
result that is not finite, a crash, more than half a minute) is a finding, named by what repeats it:
``python tests/fuzz.py --only euroc --case 17``. A case depends on its number and the seed only.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slamdepth.errors import SlamdepthError

LIMIT_S = 30
_MEMORY_BYTES = 12 * 1024**3
_BATCH = 25
_TEXTS = (".txt", ".csv", ".yaml", ".json", ".freiburg", ".cfg", ".obj", ".off", "")
# fmt: off
_ABSURD = (
    "nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", "1e999", "99999999999999999999999", "1_000",
    "", "x", "0x10", "../../etc/passwd", "/etc/passwd", "-0.0", "true", "null", "[]", "{}", "\0", "é",
    "2147483648", "18446744073709551616", "\ufeff", "1e-300", "1.7976931348623157e308", "'", '"', "&a *a",
    "!!python/name:os",
)
# fmt: on
_NUMBER = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


@dataclass(frozen=True)
class Target:
    """What is damaged and read.

    Attributes:
        make: writes a good one into a folder that is empty; returns what is to be read.
        read: reads all of it and checks that the result is sound.
    """

    name: str
    make: Callable[[Path], Path]
    read: Callable[[Path], None]


class FindingError(Exception):
    """A case ended in neither an error of one line nor a sound result."""


def run_case(target: Target, number: int, seed: int, good: tuple[Path, Path], folder: Path) -> None:
    """Run one case.

    Args:
        good: a folder, and what ``target.make`` returned for it; not changed.
        folder: absent yet; takes the damaged copy.

    Raises:
        FindingError: it ended in what it must not end in.
    """
    rng = random.Random(f"{target.name} {number} {seed}")
    shutil.copytree(good[0], folder)
    path = folder / good[1].relative_to(good[0])
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        _damage(folder, rng)
    try:
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(path)
    except SlamdepthError as error:
        message = str(error)
        if not message.strip() or "\n" in message or "\r" in message:
            raise FindingError(f"a message of several lines or none: {message[:300]!r}") from error
    except FindingError:
        raise
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise FindingError(
            f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"[:400]
        ) from error


@contextmanager
def _time_limit() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"more than {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _damage(folder: Path, rng: random.Random) -> None:
    """Damage one file of a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    if not files:
        return
    # Lists and headers are what parsers read; images are many.
    lists = [path for path in files if path.suffix not in (".png", ".jpg")]
    path = rng.choice(lists if lists and rng.random() < 0.85 else files)
    data = path.read_bytes()
    is_text = path.suffix in _TEXTS and b"\0" not in data
    ways: list[Callable[[bytes, random.Random], bytes]] = [_cut, _flip, _overwrite, _insert, _random, _grow]
    if is_text:
        ways = [*ways, *[_absurd] * 6, _drop_line, _repeat_line, _swap_lines, _other_ends]
    chosen = rng.random()
    if chosen < 0.03:
        path.unlink()
    elif chosen < 0.05:
        path.unlink()
        path.mkdir()
    elif chosen < 0.06:
        path.unlink()
        path.symlink_to(path.name)
    else:
        path.write_bytes(rng.choice(ways)(data, rng))


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if out:
            at = rng.randrange(len(out)) if rng.random() < 0.5 else rng.randrange(min(len(out), 256))
            out[at] ^= 1 << rng.randrange(8)
    return bytes(out)


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(min(len(data), 256) + 1)
    value = rng.choice((b"\xff" * 8, b"\0" * 8, b"\x7f" * 4, b"\xff\xff\xff\x7f", rng.randbytes(8)))
    return data[:at] + value + data[at + len(value) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 3, 100))) + data[at:]


def _random(data: bytes, rng: random.Random) -> bytes:
    return rng.randbytes(rng.choice((0, 1, 10, 1000, min(len(data), 100_000))))


def _grow(data: bytes, rng: random.Random) -> bytes:
    return data * rng.choice((2, 3))


def _absurd(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", errors="replace")
    found = list(_NUMBER.finditer(text)) if rng.random() < 0.8 else list(re.finditer(r"[^\s,]+", text))
    if not found:
        return data
    for match in sorted(
        rng.sample(found, min(len(found), rng.choice((1, 1, 2, 20)))), key=lambda m: -m.start()
    ):
        text = text[: match.start()] + rng.choice(_ABSURD) + text[match.end() :]
    return text.encode("utf-8", errors="surrogatepass")


def _lines(data: bytes, change: Callable[[list[bytes]], None]) -> bytes:
    lines = data.split(b"\n")
    change(lines)
    return b"\n".join(lines)


def _drop_line(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, lambda lines: lines.__delitem__(rng.randrange(len(lines))))


def _repeat_line(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, lambda lines: lines.insert(rng.randrange(len(lines)), rng.choice(lines)))


def _swap_lines(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, rng.shuffle)


def _other_ends(data: bytes, rng: random.Random) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b" ", b"\n\n", b",\n")))


def check_dataset(path: Path) -> None:
    """Open a sequence, read every frame, and check what is promised of it."""
    from slamdepth.datasets import open_dataset
    from slamdepth.datasets.summary import summarise

    dataset = open_dataset(path)
    times_s = np.asarray(dataset.timestamps_s)
    _require(len(times_s) == len(dataset) > 0, "as many times as frames, and one at least")
    _require(bool(np.isfinite(times_s).all() and (np.diff(times_s) > 0).all()), "times increase")
    camera = dataset.camera
    _require(0 < camera.width <= 20_000 and 0 < camera.height <= 20_000, "a size that an image has")
    _require(bool(np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()), "finite intrinsics")
    _require(all("\n" not in note for note in dataset.notes), "notes of one line")
    if dataset.ground_truth is not None:
        truth = dataset.ground_truth
        _require(bool(np.isfinite(truth.T_world_camera).all()), "finite poses")
        R = truth.T_world_camera[:, :3, :3]
        _require(bool(np.allclose(R @ R.swapaxes(1, 2), np.eye(3), atol=1e-6)), "rotations")
        _require(bool(np.isfinite(truth.timestamps_s).all()), "finite times of poses")
        _require(bool((np.diff(truth.timestamps_s) > 0).all()), "times of poses increase")
    errors = 0
    for index in range(min(len(dataset), 50)):
        try:
            frame = dataset.read(index, with_depth=dataset.has_depth)
        except SlamdepthError as error:
            errors += 1
            _require("\n" not in str(error), "errors of one line")
            continue
        depth_m = frame.depth_m
        _require(depth_m is None or bool(np.isfinite(depth_m).all() and (depth_m >= 0).all()), "finite depth")
    summarise(dataset)


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise FindingError(f"not so: {what}")


def _read_trajectory(path: Path) -> None:
    from slamdepth.io import read_tum_trajectory

    trajectory, _ = read_tum_trajectory(path)
    _require(bool(np.isfinite(trajectory.T_world_camera).all()), "finite poses")
    _require(bool((np.diff(trajectory.timestamps_s) > 0).all()), "times increase")


def _read_camera(path: Path) -> None:
    from slamdepth.types import Camera

    camera = Camera.from_file(path, [])
    _require(bool(np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()), "finite intrinsics")


def _read_imu(path: Path) -> None:
    from slamdepth.io.imu import read_imu

    imu, _ = read_imu(path)
    _require(bool(np.isfinite(imu.rates).all() and np.isfinite(imu.forces).all()), "finite inertial data")
    _require(bool((np.diff(imu.times_s) > 0).all()), "times increase")


def _read_config(path: Path) -> None:
    from slamdepth.config import Config

    Config.from_yaml(path)


def _read_scale(path: Path) -> None:
    from slamdepth.depth.scale_file import read_scale

    _require(bool(np.isfinite(read_scale(path).scale.scale)), "a finite scale")


def _read_surface(path: Path) -> None:
    from slamdepth.evaluation.surface_file import read_surface

    _require(bool(np.isfinite(read_surface(path).vertices_m).all()), "finite vertices")


def _read_head(path: Path) -> None:
    from slamdepth.depth.head import load_head

    load_head(path)


def targets(*, slow: bool = True) -> list[Target]:
    """All of them; without the ``slow`` ones, those that load no network and no Open3D."""
    import recordings as made
    from sequences import CAMERA, image_rgb, make_sevenscenes, make_tum, write_image

    from slamdepth.io import write_camera

    def folder_of(maker: Callable[[Path], Any]) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            found = maker(folder / "recording")
            return found[0] if isinstance(found, tuple) else Path(found)

        return make

    def images(folder: Path) -> Path:
        for i in range(4):
            write_image(folder / f"{i}.png", image_rgb(i))
        write_camera(folder / "camera.yaml", CAMERA)
        return folder

    def named(name: str, text: str) -> Callable[[Path], Path]:
        def make(folder: Path) -> Path:
            (folder / name).write_text(text, encoding="utf-8")
            return folder / name

        return make

    makers: dict[str, Callable[[Path], Path]] = {
        "tum": folder_of(lambda folder: make_tum(folder, 6)),
        "7scenes": folder_of(lambda folder: make_sevenscenes(folder, 2)),
        "images": folder_of(images),
        "euroc": folder_of(made.make_euroc),
        "kitti": folder_of(made.make_kitti),
        "icl-tum": folder_of(made.make_icl_tum),
        "replica": folder_of(made.make_replica),
        "scannet": folder_of(made.make_scannet),
        "sens": lambda folder: made.make_sens(folder / "scene.sens"),
        "stray": folder_of(made.make_stray),
        "nerfstudio": folder_of(made.make_nerfstudio),
        "polycam": folder_of(made.make_polycam),
        "colmap": folder_of(lambda folder: made.make_colmap(folder, binary=True)),
        "colmap-text": folder_of(lambda folder: made.make_colmap(folder, binary=False)),
        "r3d": lambda folder: made.make_record3d(folder / "walk.r3d", packed=_has("lzfse")),
        "record3d": folder_of(lambda folder: made.make_record3d(folder, packed=_has("lzfse"))),
        "video": lambda folder: made.make_stray(folder / "made") / "rgb.mp4",
    }
    if _has("rosbags"):
        from bags import KINDS, bag_path, small_bag

        def bag_of(kind: str, folder: Path) -> Path:
            return small_bag(bag_path(folder, kind), kind)

        for kind in KINDS:
            makers[f"bag-{kind}"] = partial(bag_of, kind)
    found = [Target(name, make, check_dataset) for name, make in makers.items()]
    euroc = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n"
    euroc += "".join(f"{1403636579763555584 + i * 50_000_000},{i},0,0,1,0,0,0\n" for i in range(9))
    tum = "# timestamp tx ty tz qx qy qz qw\n" + "".join(f"{i / 30:.6f} {i} 0 0 0 0 0 1\n" for i in range(9))
    imu = "time,gyro_x (deg/s),gyro_y (deg/s),gyro_z (deg/s),acc_x (g),acc_y (g),acc_z (g)\n"
    imu += "".join(f"{i / 100:.4f},0.1,0.2,0.3,0.0,0.1,1.0\n" for i in range(30))
    opencv = (
        "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
        "   cols: 3\n   dt: d\n   data: [ 500., 0., 320., 0., 500., 240., 0., 0., 1. ]\n"
        "distortion_coefficients: !!opencv-matrix\n   rows: 5\n   cols: 1\n   dt: d\n"
        "   data: [ 0.1, -0.2, 0., 0., 0. ]\n"
    )
    kalibr = (
        "cam0:\n  camera_model: pinhole\n  intrinsics: [190.9, 190.9, 254.9, 256.8]\n"
        "  resolution: [512, 512]\n  distortion_model: equidistant\n"
        "  distortion_coeffs: [0.0034, 0.0007, -0.002, 0.0002]\n"
    )
    plain = "width: 640\nheight: 480\nfx: 500.0\nfy: 500.0\ncx: 320\ncy: 240\nfps: 30\n"
    plain += "distortion: [0.1, 0, 0, 0, 0]\n"
    orb = "%YAML:1.0\nCamera.type: PinHole\nCamera.fx: 500.0\nCamera.fy: 500.0\nCamera.cx: 320\n"
    orb += "Camera.cy: 240\nCamera.width: 640\nCamera.height: 480\nCamera.k1: 0.1\nCamera.fps: 30\n"
    settings = "seed: 1\ndepth:\n  name: dinov2\nmap:\n  voxel_size_m: 0.02\nscale:\n  camera_height_m: 1.5\n"
    found += [
        Target("trajectory", named("groundtruth.txt", tum), _read_trajectory),
        Target("trajectory-euroc", named("data.csv", euroc), _read_trajectory),
        Target("imu", named("imu.csv", imu), _read_imu),
        Target("camera", named("camera.yaml", plain), _read_camera),
        Target("camera-opencv", named("camera.yaml", opencv), _read_camera),
        Target("camera-kalibr", named("camera.yaml", kalibr), _read_camera),
        Target("camera-orbslam", named("camera.yaml", orb), _read_camera),
        Target("config", named("config.yaml", settings), _read_config),
        Target("scale-file", _scale, _read_scale),
    ]
    if slow:
        found += [Target("ply", _mesh, _read_surface), Target("weights", _head, _read_head)]
    return found


def _scale(folder: Path) -> Path:
    from slamdepth.depth.scale import DepthScale, ScaleDomain, ScaleFit
    from slamdepth.depth.scale_file import write_scale
    from slamdepth.types import DepthKind, WeightsInfo

    fit = ScaleFit(
        scale=DepthScale(1.2, 0.0, ScaleDomain.DEPTH),
        sequence="room",
        model="dinov2",
        kind=DepthKind.METRIC,
        weights=(WeightsInfo("head", "0" * 64, "rooms", "mine"),),
        scale_sigma_log=0.01,
        shift_sigma=None,
        frames=10,
        pixels=1000,
        frame_spread_log=0.1,
        sequence_id="abc",
    )
    write_scale(folder / "scale.yaml", fit)
    return folder / "scale.yaml"


def _mesh(folder: Path) -> Path:
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "mesh.ply").write_text(head + "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    return folder / "mesh.ply"


def _head(folder: Path) -> Path:
    from slamdepth.depth.weights import head_path

    shutil.copy(head_path(), folder / "head.safetensors")
    return folder / "head.safetensors"


def _has(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None


def _work(name: str, numbers: list[int], seed: int, folder: Path, told: Any, at: Any) -> None:
    """Cases of one target in a process of its own, so that a crash costs the others nothing."""
    # libpng and OpenCV tell of each damaged image on standard error.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    (target,) = (one for one in targets() if one.name == name)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        good = Path(place) / "good"
        good.mkdir()
        path = target.make(good)
        for number in numbers:
            at.value = number
            damaged = Path(place) / f"{number}"
            try:
                run_case(target, number, seed, (good, path), damaged)
            except FindingError as finding:
                told.put((name, number, str(finding)))
            shutil.rmtree(damaged, ignore_errors=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the job; returns 1 where there is a finding."""
    parser = argparse.ArgumentParser(description="Read damaged input.")
    parser.add_argument("--cases", type=int, default=200, help="cases of each target (default: 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one target")
    parser.add_argument("--case", type=int, help="one case")
    asked = parser.parse_args(arguments)
    names = [target.name for target in targets() if asked.only in (None, target.name)]
    if not names:
        print(
            f"no target {asked.only}; there are {', '.join(one.name for one in targets())}", file=sys.stderr
        )
        return 2
    numbers = list(range(asked.cases)) if asked.case is None else [asked.case]
    context = multiprocessing.get_context("fork")
    findings = 0
    with tempfile.TemporaryDirectory(prefix="slamdepth-fuzz-") as folder:
        for name in names:
            found: list[tuple[str, int, str]] = []
            left = list(numbers)
            while left:
                batch, left = left[:_BATCH], left[_BATCH:]
                told, at = context.SimpleQueue(), context.Value("i", batch[0])
                process = context.Process(
                    target=_work, args=(name, batch, asked.seed, Path(folder), told, at)
                )
                process.start()
                process.join((LIMIT_S + 5) * len(batch))
                if process.exitcode != 0:
                    process.kill()
                    found.append((name, at.value, f"the process ended with {process.exitcode}"))
                    left = [number for number in batch if number > at.value] + left
                while not told.empty():
                    found.append(told.get())
            findings += len(found)
            print(f"{name:18} {len(numbers):6} cases {len(found):4} findings", flush=True)
            for target, number, what in found:
                print(f"    --only {target} --case {number} --seed {asked.seed}: {what}", flush=True)
    print(f"{len(names) * len(numbers)} cases, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
