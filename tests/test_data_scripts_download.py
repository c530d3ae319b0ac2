# SPDX-License-Identifier: Apache-2.0
"""The TUM downloader against a server on this machine: resuming, checking, unpacking."""

from __future__ import annotations

import hashlib
import importlib.util
import io
import re
import sys
import tarfile
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

NAME = "rgbd_dataset_freiburg1_desk"
SCRIPTS = Path(__file__).resolve().parents[1] / "data_scripts"


@pytest.fixture(scope="module")
def tum() -> ModuleType:
    spec = importlib.util.spec_from_file_location("download_tum", SCRIPTS / "download_tum.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def make_archive(members: dict[str, bytes]) -> bytes:
    stream = io.BytesIO()
    with tarfile.open(fileobj=stream, mode="w:gz") as tar:
        for name, content in members.items():
            member = tarfile.TarInfo(name)
            member.size = len(content)
            tar.addfile(member, io.BytesIO(content))
    return stream.getvalue()


NOISE = np.random.default_rng(0).bytes(300_000)  # does not compress, so that cuts fall inside
ARCHIVE = make_archive({f"{NAME}/rgb.txt": b"1.0 rgb/0.png\n", f"{NAME}/rgb/0.png": NOISE})


class Server:
    """Serves one archive; ``cut`` closes that many answers half-way."""

    def __init__(self) -> None:
        self.archive = ARCHIVE
        self.etag = '"one"'
        self.cut = 0
        self.ranges = True
        self.status: list[int] = []
        self.seen: list[tuple[str, str | None]] = []
        outer = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                outer.answer(self)

            def log_message(self, format: str, *args: object) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}"

    def answer(self, request: BaseHTTPRequestHandler) -> None:
        wanted = request.headers.get("Range")
        self.seen.append((request.path, wanted))
        if self.status:
            request.send_error(self.status.pop(0))
            return
        start, total = 0, len(self.archive)
        if wanted and self.ranges and request.headers.get("If-Range", self.etag) == self.etag:
            start = int(re.fullmatch(r"bytes=(\d+)-", wanted)[1])  # type: ignore[index]
            if start >= total:
                request.send_response(416)
                request.send_header("Content-Range", f"bytes */{total}")
                request.end_headers()
                return
            request.send_response(206)
            request.send_header("Content-Range", f"bytes {start}-{total - 1}/{total}")
        else:
            request.send_response(200)
        body = self.archive[start:]
        request.send_header("Content-Length", str(len(body)))
        request.send_header("ETag", self.etag)
        request.end_headers()
        if self.cut:
            self.cut -= 1
            body = body[: len(body) // 2]
        request.wfile.write(body)


@pytest.fixture
def server() -> Iterator[Server]:
    server = Server()
    yield server
    server.http.shutdown()
    server.http.server_close()


class Fetch:
    """``fetch`` of the script with this test's server and folder; remembers the progress."""

    def __init__(self, tum: ModuleType, server: Server, output: Path) -> None:
        self.tum, self.server, self.output = tum, server, output
        self.progress: list[tuple[int, int | None]] = []

    def __call__(self, **options: object) -> Path:
        folder: Path = self.tum.fetch(
            "fr1/desk",
            self.output,
            lambda have, total: self.progress.append((have, total)),
            base_url=self.server.url,
            wait_s=0.0,
            **options,
        )
        return folder


@pytest.fixture
def fetch(tum: ModuleType, server: Server, tmp_path: Path) -> Fetch:
    return Fetch(tum, server, tmp_path / "data")


@pytest.mark.parametrize(
    "name", ["fr1/desk", "fr1_desk", "freiburg1_desk", "freiburg1/desk", NAME, " FR1/Desk "]
)
def test_names(tum: ModuleType, name: str) -> None:
    assert tum.parse_sequence(name) == ("freiburg1", NAME)


@pytest.mark.parametrize("name", ["desk", "fr4/desk", "fr1/../x", "fr1/", "", "fr1/desk?x=1"])
def test_other_names_are_refused(tum: ModuleType, name: str) -> None:
    with pytest.raises(tum.DownloadError, match="no sequence name such as fr1/desk"):
        tum.parse_sequence(name)


def test_the_official_address(tum: ModuleType) -> None:
    camera, name = tum.parse_sequence("fr1/desk")
    assert f"{tum.BASE_URL}/{camera}/{name}.tgz" == (
        "https://cvg.cit.tum.de/rgbd/dataset/freiburg1/rgbd_dataset_freiburg1_desk.tgz"
    )
    for camera, names in tum.SEQUENCES.items():
        for short in names.split():
            assert tum.parse_sequence(f"{camera}/{short}")[0] == camera


def test_downloads_checks_and_unpacks(fetch: Fetch) -> None:
    folder = fetch()
    assert folder == fetch.output / NAME
    assert (folder / "rgb" / "0.png").read_bytes() == NOISE
    assert sorted(path.name for path in fetch.output.iterdir()) == [NAME, f"{NAME}.tgz.sha256"]
    assert (fetch.output / f"{NAME}.tgz.sha256").read_text() == (
        f"{hashlib.sha256(ARCHIVE).hexdigest()}  {NAME}.tgz\n"
    )
    assert fetch.server.seen == [(f"/freiburg1/{NAME}.tgz", None)]
    assert fetch.progress[0] == (0, len(ARCHIVE))
    assert fetch.progress[-1] == (len(ARCHIVE), len(ARCHIVE))
    assert fetch() == folder
    assert len(fetch.server.seen) == 1, "a folder already there costs no request"


def test_resumes_after_broken_connections(fetch: Fetch) -> None:
    fetch.server.cut = 3
    assert (fetch() / "rgb" / "0.png").read_bytes() == NOISE
    starts = [int(wanted[6:-1]) for _, wanted in fetch.server.seen if wanted]
    assert len(starts) == 3
    assert starts == sorted(set(starts))
    assert starts[0] == len(ARCHIVE) // 2


def test_resumes_in_another_run(fetch: Fetch, tum: ModuleType) -> None:
    fetch.server.status = [503] * 5
    with pytest.raises(tum.DownloadError, match=r"answers 503 .*run again to go on"):
        fetch()
    fetch.server.cut = 1
    fetch.server.status = []
    part = fetch.output / f"{NAME}.tgz.part"

    with pytest.raises(KeyboardInterrupt):
        stop_half_way(tum, fetch)
    have = part.stat().st_size
    assert 0 < have < len(ARCHIVE)
    fetch.server.seen.clear()
    fetch.server.cut = 0
    assert (fetch() / "rgb" / "0.png").read_bytes() == NOISE
    assert fetch.server.seen == [(f"/freiburg1/{NAME}.tgz", f"bytes={have}-")]
    assert not part.exists()


def stop_half_way(tum: ModuleType, fetch: Fetch) -> None:
    def stop(have: int, total: int | None) -> None:
        if have:
            raise KeyboardInterrupt

    tum.fetch("fr1/desk", fetch.output, stop, base_url=fetch.server.url, wait_s=0.0)


def test_starts_over_if_the_file_changed_or_ranges_are_unsupported(fetch: Fetch) -> None:
    part = fetch.output / f"{NAME}.tgz.part"
    for etag, ranges in (('"older"', True), ('"one"', False)):
        fetch.server.ranges = ranges
        part.parent.mkdir(exist_ok=True)
        part.write_bytes(b"of another file")
        part.with_name(part.name + ".etag").write_text(etag)
        folder = fetch()
        assert (folder / "rgb" / "0.png").read_bytes() == NOISE
        (fetch.output / f"{NAME}.tgz.sha256").unlink()
        for path in (folder / "rgb" / "0.png", folder / "rgb.txt"):
            path.unlink()
        (folder / "rgb").rmdir()
        folder.rmdir()


@pytest.mark.parametrize("extra", [0, 7])
def test_a_part_file_that_is_complete_or_too_long(fetch: Fetch, extra: int) -> None:
    fetch.output.mkdir()
    (fetch.output / f"{NAME}.tgz.part").write_bytes(ARCHIVE + b"x" * extra)
    assert (fetch() / "rgb" / "0.png").read_bytes() == NOISE
    assert len(fetch.server.seen) == (2 if extra else 1)


def test_gives_up_with_one_line(fetch: Fetch, tum: ModuleType) -> None:
    fetch.server.status = [404]
    with pytest.raises(tum.DownloadError, match="the server answers 404"):
        fetch()
    assert len(fetch.server.seen) == 1
    fetch.server.http.shutdown()
    fetch.server.http.server_close()
    with pytest.raises(tum.DownloadError, match="connection failed"):
        fetch()


def test_a_given_checksum_is_enforced(fetch: Fetch, tum: ModuleType) -> None:
    with pytest.raises(tum.DownloadError, match=r"SHA-256 is \w{64}, --sha256 says 00; delete it"):
        fetch(sha256="00")
    assert sorted(path.name for path in fetch.output.iterdir()) == [f"{NAME}.tgz"], (
        "neither unpacked nor recorded"
    )
    assert fetch(sha256=hashlib.sha256(ARCHIVE).hexdigest().upper()).is_dir()


def test_a_recorded_checksum_is_compared(fetch: Fetch, tum: ModuleType) -> None:
    fetch.output.mkdir()
    (fetch.output / f"{NAME}.tgz.sha256").write_text("ab  x\n")
    with pytest.raises(tum.DownloadError, match=rf"{NAME}\.tgz\.sha256 says ab"):
        fetch()
    assert not (fetch.output / NAME).exists()


@pytest.mark.parametrize("position", [-6, len(ARCHIVE) // 2])
def test_a_damaged_archive_is_refused(fetch: Fetch, tum: ModuleType, position: int) -> None:
    damaged = bytearray(ARCHIVE)
    damaged[position] ^= 0xFF
    fetch.server.archive = bytes(damaged)
    with pytest.raises(tum.DownloadError, match="damaged"):
        fetch()
    assert not (fetch.output / f"{NAME}.tgz.sha256").exists()


@pytest.mark.parametrize("name", ["../outside.txt", "/tmp/outside.txt", f"{NAME}/../../outside.txt"])
def test_nothing_is_written_outside(fetch: Fetch, tum: ModuleType, name: str, tmp_path: Path) -> None:
    fetch.server.archive = make_archive({f"{NAME}/rgb.txt": b"", name: b"x"})
    if name.startswith("/"):  # tarfile strips the slash, so this one lands inside, as a second folder
        with pytest.raises(tum.DownloadError, match="expected one folder inside, found 2"):
            fetch()
    else:
        with pytest.raises(tum.DownloadError, match="not unpacked"):
            fetch()
    assert not list(tmp_path.rglob("outside.txt"))
    assert not Path("/tmp/outside.txt").exists()
    assert not (fetch.output / NAME).exists()


def test_the_command_line(
    tum: ModuleType, server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["fr1/desk", "--output", str(tmp_path), "--base-url", server.url + "/"]
    assert tum.main([*arguments, "--keep-archive"]) == 0
    assert (tmp_path / f"{NAME}.tgz").read_bytes() == ARCHIVE
    assert tum.main(["nonsense"]) == 1
    error = capsys.readouterr().err
    assert error.startswith("error: 'nonsense' is no sequence name")
    assert error.count("\n") == 1
    assert tum.main(["--list"]) == 0
    assert "fr1/desk " in capsys.readouterr().out
    with pytest.raises(SystemExit):
        tum.main([])
