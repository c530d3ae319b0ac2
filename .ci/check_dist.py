# SPDX-License-Identifier: Apache-2.0
"""Checks the built wheel and sdist, and installs the wheel into empty environments.

python .ci/check_dist.py dist                                   (``make check-dist``)
python .ci/check_dist.py dist --install python3.10 python3.13   (needs a gigabyte for each)
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from email.parser import Parser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MAX_FILE_BYTES = 4 * 2**20
"""Larger files are data or weights, which are not shipped; the depth head has 2.2 MB."""
NEEDED = (
    "slamdepth/py.typed",
    "slamdepth/assets/dinov2_head.safetensors",
    "slamdepth/assets/dinov2_head.md",
    "slamdepth/assets/orb_vocabulary.npz",
    "slamdepth/assets/orb_vocabulary.md",
    "slamdepth/report/templates/base.html.j2",
    "slamdepth/report/templates/report.css",
)
UNWANTED = ("__pycache__", ".pyc", ".egg-info", ".hypothesis", ".log", ".ply", ".mp4", ".bag", ".rrd")
WORKS = """
set -e
slamdepth --version
python -m slamdepth --help > help.txt
slamdepth synth room --frames 12 --quiet
slamdepth run room --depth sensor --output run --export tum,glb,nerfstudio --quiet
test -s run/export/nerfstudio/transforms.json
python -c "import slamdepth; print(len(slamdepth.export_run('run', 'kitti').name))"
"""
"""What an installed copy must be able to do, as a shell script."""


def main(arguments: list[str] | None = None) -> int:
    """Check what lies in a folder; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="of one wheel and one sdist")
    parser.add_argument("--install", nargs="*", default=[], metavar="PYTHON", help="interpreters")
    asked = parser.parse_args(arguments)
    wheel, sdist = only(asked.folder, "*.whl"), only(asked.folder, "*.tar.gz")
    problems = [*check_wheel(wheel), *check_sdist(sdist)]
    for problem in problems:
        print(f"error: {problem}", file=sys.stderr)
    if problems:
        return 1
    print(f"{wheel.name}: {wheel.stat().st_size / 2**20:.1f} MiB, {sdist.name}: as the wheel, with sources")
    return max((install(python, wheel) for python in asked.install), default=0)


def only(folder: Path, pattern: str) -> Path:
    """The one file of a pattern.

    Raises:
        SystemExit: there is none, or there are several.
    """
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise SystemExit(f"error: {folder}: has {len(found)} files {pattern}, expected one: empty it first")
    return found[0]


def check_wheel(path: Path) -> list[str]:
    """What is wrong with a wheel, a line each."""
    with zipfile.ZipFile(path) as archive:
        sizes = {info.filename: info.file_size for info in archive.infolist()}
        (metadata,) = (name for name in sizes if name.endswith(".dist-info/METADATA"))
        about = Parser().parsestr(archive.read(metadata).decode())
        entry_points = archive.read(metadata.replace("METADATA", "entry_points.txt")).decode()
    inside = [name for name in sizes if ".dist-info/" not in name]
    problems = [f"{path.name}: lacks {name}" for name in missing_sources(inside)]
    problems += [f"{path.name}: holds {name}" for name in inside if not name.startswith("slamdepth/")]
    problems += sized_problems(path, sizes)
    if not any(name.endswith("licenses/LICENSE") for name in sizes):
        problems.append(f"{path.name}: lacks the licence")
    if about["License-Expression"] != "Apache-2.0" or about["Requires-Python"] != ">=3.10":
        problems.append(f"{path.name}: licence or Python versions of its metadata are not ours")
    if "slamdepth = slamdepth.cli:main" not in entry_points:
        problems.append(f"{path.name}: has no command 'slamdepth'")
    return problems


def check_sdist(path: Path) -> list[str]:
    """What is wrong with an sdist, a line each."""
    with tarfile.open(path) as archive:
        sizes = {member.name.partition("/")[2]: member.size for member in archive if member.isfile()}
    needed = ("pyproject.toml", "README.md", "LICENSE", "CHANGELOG.md", "constraints.txt", "PKG-INFO")
    problems = [
        f"{path.name}: lacks {name}" for name in (*missing_sources(sizes), *needed) if name not in sizes
    ]
    return problems + sized_problems(path, sizes)


def missing_sources(names: list[str] | dict[str, int]) -> list[str]:
    """Files of the package in this checkout, and those it cannot do without, that are not among names."""
    sources = {path.relative_to(ROOT).as_posix() for path in (ROOT / "slamdepth").rglob("*.py")}
    return sorted({*sources, *NEEDED} - set(names))


def sized_problems(path: Path, sizes: dict[str, int]) -> list[str]:
    """Files that are too large, or of a kind that is not shipped."""
    large = [f"{path.name}: {name} has {size} bytes" for name, size in sizes.items() if size > MAX_FILE_BYTES]
    unwanted = [f"{path.name}: holds {name}" for name in sizes if any(kind in name for kind in UNWANTED)]
    return large + unwanted


def install(python: str, wheel: Path) -> int:
    """Install a wheel into an empty environment and use it; returns an exit code."""
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        try:
            subprocess.run([python, "-m", "venv", str(place / "venv")], check=True)
            binaries = place / "venv" / "bin"
            pip = [str(binaries / "python"), "-m", "pip", "install", "--quiet", "--no-cache-dir"]
            subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), str(wheel.resolve())], check=True)
            subprocess.run(
                ["bash", "-c", WORKS],
                cwd=place,
                check=True,
                env={"PATH": f"{binaries}:/usr/bin:/bin", "HOME": folder, "OMP_NUM_THREADS": "1"},
            )
        except (subprocess.CalledProcessError, OSError) as error:
            print(f"error: {python}: {error}", file=sys.stderr)
            return 1
    print(f"{python}: installed into an empty environment; a run and its exports work")
    return 0


if __name__ == "__main__":
    sys.exit(main())
