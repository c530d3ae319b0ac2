# SPDX-License-Identifier: Apache-2.0
"""Check that two versions of the package give the same trajectories, byte for byte.

    python -m benchmarks.same_trajectories record main.json            # in a checkout of the old version
    python -m benchmarks.same_trajectories check main.json             # in a checkout of the new one

Runs ``slamdepth run`` on freiburg1_rpy, freiburg1_desk, the 7-Scenes kitchen and a rendered room, each with
predicted and, where there is one, sensor depth. Bytes are equal on one machine and one set of package
versions only, so each machine records its own file of digests, and none is kept in the repository.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.command import parser_of
from benchmarks.jobs import ROOT
from slamdepth.io import write_json

FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.txt")
RUNS = (
    ("room", "sensor"),
    ("room", "dinov2"),
    ("7scenes_redkitchen_seq-01", "sensor"),
    ("7scenes_redkitchen_seq-01", "dinov2"),
    ("rgbd_dataset_freiburg1_rpy", "sensor"),
    ("rgbd_dataset_freiburg1_rpy", "dinov2"),
    ("rgbd_dataset_freiburg1_desk", "dinov2"),
)
ROOM_FRAMES = 300


def slamdepth(*arguments: str) -> None:
    """Run the command line of this checkout; it shares standard error.

    Raises:
        subprocess.CalledProcessError: it failed.
    """
    command = [sys.executable, "-m", "slamdepth", *arguments, "--quiet"]
    subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL)


def digests(data: Path, work: Path, *, mesh: bool = False) -> dict[str, dict[str, str]]:
    """Run everything; sha256 of the files of each run by ``sequence/depth``, without absent sequences."""
    room = work / "room"
    if not room.is_dir():
        slamdepth("synth", str(room), "--frames", str(ROOM_FRAMES), "--seed", "1")
    found: dict[str, dict[str, str]] = {}
    for name, depth in RUNS:
        sequence = room if name == "room" else data / name
        if not sequence.is_dir():
            print(f"{name}: absent in {data.name}/, left out", file=sys.stderr)
            continue
        output = work / f"{name}-{depth}"
        slamdepth(
            "run", str(sequence), "--depth", depth, "--output", str(output), "--overwrite",
            *([] if mesh else ["--no-mesh"]),
        )  # fmt: skip
        files = (*FILES, "mesh.ply") if mesh else FILES
        found[f"{name}/{depth}"] = {
            file: hashlib.sha256((output / file).read_bytes()).hexdigest() for file in files
        }
        print(f"{name}/{depth}: {found[f'{name}/{depth}']['trajectory.txt'][:12]}", flush=True)
    return found


def differences(old: dict[str, dict[str, str]], new: dict[str, dict[str, str]]) -> list[str]:
    """One line for each file whose bytes differ, and for each run that only one side has."""
    lines = [f"{run}: only one side has it" for run in sorted(set(old) ^ set(new))]
    for run in sorted(set(old) & set(new)):
        shared = sorted(set(old[run]) & set(new[run]))
        lines += [f"{run}: {file} differs" for file in shared if old[run][file] != new[run][file]]
    return lines


def main(arguments: list[str] | None = None) -> int:
    """Run the command; returns its exit code, 1 where bytes differ."""
    parser = parser_of("same_trajectories", __doc__)
    parser.add_argument("action", choices=("record", "check"))
    parser.add_argument("file", type=Path, help="JSON file of digests")
    parser.add_argument(
        "--data",
        type=Path,
        default=Path(os.environ.get("SLAMDEPTH_DATA", ROOT.parent / "shared" / "data")),
        help="folder of the real sequences; default: $SLAMDEPTH_DATA",
    )
    parser.add_argument(
        "--work", type=Path, help="folder of the rendered room and the runs (default: temporary)"
    )
    parser.add_argument("--mesh", action="store_true", help="compare meshes too")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="same-trajectories-") as temporary:
        work = options.work or Path(temporary)
        work.mkdir(parents=True, exist_ok=True)
        found = digests(options.data, work.resolve(), mesh=options.mesh)
    if options.action == "record":
        write_json(options.file, found)
        return 0
    old = json.loads(options.file.read_text(encoding="utf-8"))
    lines = differences(old, found)
    print("\n".join(lines) if lines else f"{len(found)} runs, the same bytes")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
