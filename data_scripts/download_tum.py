#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Download sequences of the TUM RGB-D benchmark (CC BY 4.0) and unpack them.

    python data_scripts/download_tum.py fr1/desk fr1/rpy --output data

An interrupted download resumes where it stopped. The benchmark publishes no checksums, so none are built
in. Instead, the script checks the size given by the server, the CRC inside the gzip file, and a SHA-256 that
is written to ``ARCHIVE.sha256`` after the first download and compared whenever the archive is used again.
That record shows that an archive has not changed since, not that the first download was genuine. A known
SHA-256 can be given with ``--sha256``.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import http.client
import os
import re
import shutil
import sys
import tarfile
import time
import urllib.error
import urllib.request
import zlib
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.progress import (
    BarColumn,
    DownloadColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)

BASE_URL = "https://cvg.cit.tum.de/rgbd/dataset"
SEQUENCES = {
    "freiburg1": "360 desk desk2 floor plant room rpy teddy xyz",
    "freiburg2": "360_hemisphere 360_kidnap coke desk desk_with_person dishes flowerbouquet "
    "flowerbouquet_brownbackground large_no_loop large_with_loop metallic_sphere metallic_sphere2 "
    "pioneer_360 pioneer_slam pioneer_slam2 pioneer_slam3 rpy xyz",
    "freiburg3": "cabinet large_cabinet long_office_household nostructure_notexture_far "
    "nostructure_notexture_near_withloop nostructure_texture_far nostructure_texture_near_withloop "
    "sitting_halfsphere sitting_rpy sitting_static sitting_xyz structure_notexture_far "
    "structure_notexture_near structure_texture_far structure_texture_near teddy walking_halfsphere "
    "walking_rpy walking_static walking_xyz",
}
CHUNK_BYTES = 1 << 18

OnProgress = Callable[[int, int | None], None]
"""Called with the bytes downloaded and the total, None if unknown."""


class DownloadError(Exception):
    """An error that ends the script with one line."""


class _Interrupted(Exception):
    """The connection failed; the download is attempted again."""


def parse_sequence(name: str) -> tuple[str, str]:
    """Camera and full name of ``fr1/desk``, ``freiburg1_desk`` or ``rgbd_dataset_freiburg1_desk``.

    Raises:
        DownloadError: ``name`` has none of these forms.
    """
    found = re.fullmatch(r"(?:rgbd_dataset_)?(?:freiburg|fr)([123])[_/]([a-z0-9_]+)", name.strip().lower())
    if not found:
        raise DownloadError(f"{name!r} is no sequence name such as fr1/desk; --list shows the known ones")
    camera = f"freiburg{found[1]}"
    return camera, f"rgbd_dataset_{camera}_{found[2]}"


def download(
    url: str, archive: Path, on_progress: OnProgress, *, attempts: int = 5, wait_s: float = 2.0
) -> None:
    """Download ``url`` to ``archive``, resuming from ``archive.part`` if it exists.

    Raises:
        DownloadError: the server refuses, or ``attempts`` in a row make no progress.
    """
    part = archive.with_name(archive.name + ".part")
    left = attempts
    while True:
        before = _size(part)
        try:
            _download_once(url, part, on_progress)
            break
        except _Interrupted as error:
            left = attempts if _size(part) > before else left - 1
            if left <= 0:
                raise DownloadError(f"{url}: {error}; run again to go on from {part}") from error
            time.sleep(wait_s)
    os.replace(part, archive)
    _tag_path(part).unlink(missing_ok=True)


def _download_once(url: str, part: Path, on_progress: OnProgress) -> None:
    have, tag = _size(part), _read_tag(part)
    headers = {"Accept-Encoding": "identity"}
    if have:
        headers["Range"] = f"bytes={have}-"
        if tag:
            headers["If-Range"] = tag  # the server starts over if the file has changed
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60) as response:
            have, total = _accept(url, response, have)
            _tag_path(part).write_text(
                response.headers.get("ETag") or response.headers.get("Last-Modified") or ""
            )
            with part.open("ab" if have else "wb") as file:
                on_progress(have, total)
                while chunk := response.read(CHUNK_BYTES):
                    file.write(chunk)
                    have += len(chunk)
                    on_progress(have, total)
    except urllib.error.HTTPError as error:
        _explain(url, part, have, error)
    except (urllib.error.URLError, http.client.HTTPException, ConnectionError, TimeoutError) as error:
        raise _Interrupted(f"connection failed: {getattr(error, 'reason', None) or error}") from error
    else:
        if total is not None and have < total:
            raise _Interrupted(f"the connection ended at {have} of {total} bytes")
        if total is not None and have > total:
            part.unlink()
            raise DownloadError(f"{url}: got {have} bytes, the server said {total}; run again to start over")


def _accept(url: str, response: http.client.HTTPResponse, have: int) -> tuple[int, int | None]:
    """Bytes to keep and total bytes to expect, from the response headers."""
    length = response.headers.get("Content-Length")
    if response.status != 206:
        return 0, int(length) if length else None
    found = re.fullmatch(r"bytes (\d+)-\d+/(\d+|\*)", response.headers.get("Content-Range", ""))
    if not found or int(found[1]) != have:
        raise DownloadError(f"{url}: the server answered with another range than bytes {have}-")
    if found[2] != "*":
        return have, int(found[2])
    return have, have + int(length) if length else None


def _explain(url: str, part: Path, have: int, error: urllib.error.HTTPError) -> None:
    """Raise the error for an HTTP error; return if the part file is already complete."""
    if error.code == 416:
        found = re.fullmatch(r"bytes \*/(\d+)", error.headers.get("Content-Range", ""))
        if found and int(found[1]) == have:
            return
        part.unlink(missing_ok=True)
        raise _Interrupted("the part file does not fit the server's file; starting over") from error
    if error.code >= 500 or error.code == 429:
        raise _Interrupted(f"the server answers {error.code} {error.reason}") from error
    raise DownloadError(f"{url}: the server answers {error.code} {error.reason}") from error


def _size(path: Path) -> int:
    return path.stat().st_size if path.exists() else 0


def _tag_path(part: Path) -> Path:
    return part.with_name(part.name + ".etag")


def _read_tag(part: Path) -> str:
    path = _tag_path(part)
    tag = path.read_text().strip() if path.exists() else ""
    return "" if tag.startswith("W/") else tag  # If-Range takes no weak tags


def verify(archive: Path, expected_sha256: str | None) -> str:
    """Check an archive's CRC and SHA-256, and record the latter the first time.

    Args:
        archive: the ``.tgz``.
        expected_sha256: the required SHA-256, or None for the one in ``ARCHIVE.sha256``, if any.

    Returns:
        The SHA-256 in hexadecimal.

    Raises:
        DownloadError: the archive has another SHA-256 or is damaged.
    """
    record = archive.with_name(archive.name + ".sha256")
    digest = _sha256(archive)
    recorded = record.read_text().split()[:1] if record.exists() else []
    for origin, value in (("--sha256", expected_sha256), (str(record), recorded[0] if recorded else None)):
        if value and value.lower() != digest:
            raise DownloadError(
                f"{archive}: SHA-256 is {digest}, {origin} says {value.lower()}; delete it to download again"
            )
    try:
        with gzip.open(archive) as stream:
            while stream.read(CHUNK_BYTES):
                pass
    except (OSError, EOFError, zlib.error) as error:
        raise DownloadError(f"{archive}: damaged ({error}); delete it to download again") from error
    if not recorded:
        record.write_text(f"{digest}  {archive.name}\n")
    return digest


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(1 << 20):
            digest.update(chunk)
    return digest.hexdigest()


def extract(archive: Path, folder: Path) -> None:
    """Unpack the one folder in ``archive`` to ``folder``, whole or not at all.

    Raises:
        DownloadError: the archive is damaged, reaches outside ``folder``, or holds none
            or several folders.
    """
    staging = folder.with_name(f".{folder.name}.extracting")
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    try:
        with tarfile.open(archive, "r:gz") as tar:
            # The filter refuses absolute names, '..', links out of the folder, and devices.
            tar.extractall(staging, filter="data")
        inside = list(staging.iterdir())
        if len(inside) != 1 or not inside[0].is_dir():
            raise DownloadError(f"{archive}: expected one folder inside, found {len(inside)} entries")
        os.replace(inside[0], folder)
    except (tarfile.TarError, EOFError, zlib.error) as error:
        raise DownloadError(f"{archive}: not unpacked: {error}") from error
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def fetch(
    name: str,
    output: Path,
    on_progress: OnProgress,
    *,
    base_url: str = BASE_URL,
    sha256: str | None = None,
    keep_archive: bool = False,
    wait_s: float = 2.0,
) -> Path:
    """Download, verify and unpack one sequence; an existing folder is not changed.

    Returns:
        The sequence's folder.

    Raises:
        DownloadError: one line that says what is wrong and what to do.
    """
    camera, full_name = parse_sequence(name)
    folder, archive = output / full_name, output / f"{full_name}.tgz"
    if folder.exists():
        return folder
    output.mkdir(parents=True, exist_ok=True)
    if not archive.exists():
        download(f"{base_url}/{camera}/{full_name}.tgz", archive, on_progress, wait_s=wait_s)
    verify(archive, sha256)
    extract(archive, folder)
    if not keep_archive:
        archive.unlink()
    return folder


def _bar(progress: Progress, name: str) -> OnProgress:
    task = progress.add_task(name, total=None)
    return lambda have, total: progress.update(task, completed=have, total=total)


def main(argv: list[str] | None = None) -> int:
    """Run the script; returns its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="*", metavar="SEQUENCE", help="such as fr1/desk")
    parser.add_argument("--output", type=Path, default=Path("data"), help="folder for the sequences (data)")
    parser.add_argument("--list", action="store_true", help="show the sequences known by name")
    parser.add_argument("--sha256", help="what the archive must have; for a single sequence")
    parser.add_argument("--keep-archive", action="store_true", help="keep the .tgz after unpacking")
    parser.add_argument("--base-url", default=BASE_URL, help=f"a mirror of {BASE_URL}")
    args = parser.parse_args(argv)

    console = Console()
    if args.list:
        for camera, names in SEQUENCES.items():
            console.print(" ".join(f"{camera}/{name}" for name in names.split()).replace("freiburg", "fr"))
        return 0
    if not args.sequences:
        parser.error("name at least one sequence, or --list")
    if args.sha256 and len(args.sequences) > 1:
        parser.error("--sha256 goes with a single sequence")

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TransferSpeedColumn())
    try:
        with Progress(*columns, TimeRemainingColumn(), console=console) as progress:
            for name in args.sequences:
                folder = fetch(
                    name,
                    args.output,
                    _bar(progress, name),
                    base_url=args.base_url.rstrip("/"),
                    sha256=args.sha256,
                    keep_archive=args.keep_archive,
                )
                progress.console.print(f"{name}: {folder}", soft_wrap=True)
    except (DownloadError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted; run again to go on", file=sys.stderr)
        return 130
    return 0


if __name__ == "__main__":
    sys.exit(main())
