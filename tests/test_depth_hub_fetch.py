# SPDX-License-Identifier: Apache-2.0
"""Downloading from a hub: a local server that speaks what huggingface_hub asks for, and the command line."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

pytest.importorskip("huggingface_hub", reason="needs pip install 'slamdepth[hub]'")

from slamdepth.depth import hub_fetch, hub_models, hub_store
from slamdepth.errors import WeightsError

COMMIT, LATER = "c" * 40, "d" * 40
WEIGHTS = bytes(range(256)) * 400
REPO = "me/tiny"


@dataclass
class Hub:
    """What the server has, and what it was asked.

    Attributes:
        files: contents by ``ORG/NAME/FILE``.
        commit: of ``main``.
        announced: contents that checksums are announced of, where they are not the true ones.
        gated: models that answer 401.
        cut_after: bytes of the weights after which a connection breaks, once each.
        asked: method, path and range of each request for a file.
    """

    files: dict[str, bytes]
    commit: str = COMMIT
    announced: dict[str, bytes] = field(default_factory=dict)
    gated: set[str] = field(default_factory=set)
    cut_after: list[int] = field(default_factory=list)
    asked: list[tuple[str, str, str | None]] = field(default_factory=list)
    url: str = ""

    def answer(self, request: BaseHTTPRequestHandler, *, with_body: bool) -> None:
        """Answer ``/ORG/NAME/resolve/REVISION/FILE`` as the hub does."""
        if "/resolve/" not in request.path:  # what else the library asks for
            request.send_error(404)
            return
        self.asked.append((request.command, request.path, request.headers.get("Range")))
        org, name, _, revision, file = request.path.lstrip("/").split("/", 4)
        content = self.files.get(f"{org}/{name}/{file}")
        known = {path.rsplit("/", 1)[0] for path in self.files}
        headers = {"X-Repo-Commit": self.commit, "Accept-Ranges": "bytes"}
        status, body = 200, content or b""
        if f"{org}/{name}" in self.gated:
            status, headers["X-Error-Code"] = 401, "GatedRepo"
        elif f"{org}/{name}" not in known:
            status, headers["X-Error-Code"] = 401, "RepoNotFound"
        elif revision not in ("main", self.commit):
            status, headers["X-Error-Code"] = 404, "RevisionNotFound"
        elif content is None:
            status, headers["X-Error-Code"] = 404, "EntryNotFound"
        if status == 200:
            announced = self.announced.get(file, body)
            if file.endswith(".safetensors"):
                headers["X-Linked-ETag"] = f'"{hashlib.sha256(announced).hexdigest()}"'
                headers["X-Linked-Size"] = str(len(body))
            header = b"blob %d\0" % len(announced)
            headers["ETag"] = f'"{hashlib.sha1(header + announced).hexdigest()}"'
            if (asked := request.headers.get("Range")) is not None:
                start = int(asked.removeprefix("bytes=").rstrip("-"))
                headers["Content-Range"] = f"bytes {start}-{len(body) - 1}/{len(body)}"
                status, body = 206, body[start:]
        else:
            body = b""
        request.send_response(status)
        for key, value in {**headers, "Content-Length": str(len(body))}.items():
            request.send_header(key, value)
        request.end_headers()
        if with_body:
            if self.cut_after and file.endswith(".safetensors"):
                body = body[: self.cut_after.pop(0)]
                request.close_connection = True
            request.wfile.write(body)


def point_to(monkeypatch: pytest.MonkeyPatch, url: str) -> None:
    """Make ``url`` the hub of this process, as ``HF_ENDPOINT`` does when the library is imported."""
    from huggingface_hub import constants, file_download

    template = url + "/{repo_id}/resolve/{revision}/{filename}"
    monkeypatch.setattr(constants, "ENDPOINT", url)
    for module in (constants, file_download):
        monkeypatch.setattr(module, "HUGGINGFACE_CO_URL_TEMPLATE", template, raising=False)


@pytest.fixture
def hub(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Hub]:
    files = {
        f"{REPO}/config.json": b'{"model_type": "dpt"}',
        f"{REPO}/preprocessor_config.json": b"{}",
        f"{REPO}/model.safetensors": WEIGHTS,
    }
    served = Hub(files)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_HEAD(self) -> None:
            served.answer(self, with_body=False)

        def do_GET(self) -> None:
            served.answer(self, with_body=True)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    served.url = f"http://127.0.0.1:{server.server_address[1]}"
    point_to(monkeypatch, served.url)
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "hf"))
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", False)
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    yield served
    server.shutdown()
    server.server_close()


def refused(match: str, name: str = f"hf:{REPO}") -> str:
    with pytest.raises(WeightsError, match=match) as error:
        hub_fetch.pull(hub_store.reference_of(name))
    assert "\n" not in str(error.value)
    assert not hub_store.reference_of(name).folder.exists()
    return str(error.value)


def gets(hub: Hub) -> list[tuple[str, str | None]]:
    return [(path.rsplit("/", 1)[1], part) for method, path, part in hub.asked if method == "GET"]


def test_a_model_is_pulled_once_and_recorded(hub: Hub) -> None:
    steps: list[tuple[str, float]] = []
    reference = hub_store.reference_of(f"hf:{REPO}")
    folder = hub_fetch.pull(reference, lambda what, share: steps.append((what, share)))
    assert folder == reference.folder
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS
    record = hub_store.read_record(folder)
    assert record is not None
    assert (record.repo, record.revision) == (REPO, COMMIT)
    assert record.sha256["model.safetensors"] == hashlib.sha256(WEIGHTS).hexdigest()
    files = ["config.json", "model.safetensors", "preprocessor_config.json", hub_store.RECORD]
    assert sorted(path.name for path in folder.iterdir()) == sorted(files)
    assert [path.name for path in folder.parent.iterdir()] == ["tiny"]
    assert any("downloading model.safetensors, 0.1 MB" in what for what, _ in steps)
    assert [share for _, share in steps] == sorted(share for _, share in steps)
    # All files but the first are asked for at the commit of the first.
    assert not any("/resolve/main/" in path for _, path, _ in hub.asked[2:]), hub.asked
    before = len(hub.asked)
    assert hub_fetch.pull(reference) == folder
    assert hub_fetch.pull(hub_store.reference_of(f"hf:{REPO}@{COMMIT}")) == folder
    assert len(hub.asked) == before
    assert hub_store.checked_sha256(folder / "model.safetensors") == record.sha256["model.safetensors"]


def test_a_new_revision_replaces_the_old_one_only_when_it_is_complete(hub: Hub) -> None:
    folder = hub_fetch.pull(hub_store.reference_of(f"hf:{REPO}"))
    hub.commit, hub.files[f"{REPO}/model.safetensors"] = LATER, WEIGHTS[::-1]
    hub.announced["model.safetensors"] = b"another"
    later = hub_store.reference_of(f"hf:{REPO}@{LATER}")
    with pytest.raises(WeightsError, match="not the one that the hub announced"):
        hub_fetch.pull(later)
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS
    hub.announced.clear()
    assert hub_fetch.pull(later) == folder
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS[::-1]


def test_a_broken_connection_goes_on_where_it_stopped(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "DOWNLOAD_CHUNK_SIZE", 10_000)  # the last chunk that is whole is kept
    hub.cut_after = [30_000]
    folder = hub_fetch.pull(hub_store.reference_of(f"hf:{REPO}"))
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS
    assert [part for name, part in gets(hub) if name == "model.safetensors"] == [None, "bytes=30000-"]


def test_a_pull_that_was_killed_goes_on_where_it_stopped(hub: Hub) -> None:
    reference = hub_store.reference_of(f"hf:{REPO}")
    partial = reference.folder.with_name("tiny.partial")
    partial.mkdir(parents=True)
    digest = hashlib.sha256(WEIGHTS).hexdigest()
    (partial / f"model.safetensors.{digest[:16]}.part").write_bytes(WEIGHTS[:70_000])
    (partial / "config.json").write_bytes(hub.files[f"{REPO}/config.json"])
    folder = hub_fetch.pull(reference)
    assert (folder / "model.safetensors").read_bytes() == WEIGHTS
    assert gets(hub) == [("preprocessor_config.json", None), ("model.safetensors", "bytes=70000-")]
    assert not partial.exists()


def test_another_file_than_announced_is_not_used(hub: Hub) -> None:
    hub.announced["model.safetensors"] = b"another"
    refused("model.safetensors of me/tiny: the downloaded file is not the one that the hub announced")
    hub.announced = {"config.json": b"another"}
    refused(r"config\.json of me/tiny: the downloaded file is not the one")


def test_another_file_than_pinned_is_not_used(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    model = hub_models.BY_NAME["depth-anything-v2-small"]
    assert model.revision is not None
    hub.commit = model.revision
    for name in ("config.json", "model.safetensors"):
        hub.files[f"{model.repo}/{name}"] = hub.files[f"{REPO}/{name}"]
    refused("sha256 is .*, not the pinned 3152477ce0d8d697", "depth-anything-v2-small")
    # Another revision that was asked for is not pinned; and no image processor is needed.
    hub.commit = LATER
    folder = hub_fetch.pull(hub_store.reference_of(f"hf:{model.repo}@{LATER}"))
    assert not (folder / "preprocessor_config.json").exists()


def test_models_that_are_not_to_be_had_are_one_line(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    by_hand = f"put config.json, preprocessor_config.json and model.safetensors of {REPO} into"
    refused("no such model, or it is private", "hf:me/absent")
    refused(f"has no revision {LATER}", f"hf:{REPO}@{LATER}")
    hub.gated.add(REPO)
    assert by_hand in refused(f"{REPO} is gated: accept its terms on {hub.url}/{REPO} and set HF_TOKEN")
    hub.gated.clear()
    weights = hub.files.pop(f"{REPO}/model.safetensors")
    refused("has no weights that are read here")
    hub.files[f"{REPO}/pytorch_model.bin"] = weights
    config = hub.files.pop(f"{REPO}/config.json")
    refused(r"it has no config\.json")
    hub.files[f"{REPO}/config.json"] = config
    point_to(monkeypatch, "http://127.0.0.1:9")
    text = refused("^http://127.0.0.1:9 cannot be reached: ")
    assert by_hand in text
    assert str(hub_store.reference_of(f"hf:{REPO}").folder) in text


def test_divided_weights_are_pulled_part_by_part(hub: Hub) -> None:
    del hub.files[f"{REPO}/model.safetensors"]
    names = [f"model-0000{k}-of-00002.safetensors" for k in (1, 2)]
    index = {"weight_map": {"a": names[0], "b": names[1], "c": names[0]}}
    hub.files[f"{REPO}/{hub_store.INDEX}"] = json.dumps(index).encode()
    for name in names:
        hub.files[f"{REPO}/{name}"] = name.encode()
    folder = hub_fetch.pull(hub_store.reference_of(f"hf:{REPO}"))
    assert [path.name for path in hub_store.weights_files(folder)] == names
    hub.files[f"{REPO}/{hub_store.INDEX}"] = json.dumps({"weight_map": {"a": "../x.safetensors"}}).encode()
    hub.commit = LATER
    with pytest.raises(WeightsError, match="not an index of weights files"):
        hub_fetch.pull(hub_store.reference_of(f"hf:{REPO}@{LATER}"))


def test_what_another_program_left_in_the_hubs_cache_is_used(hub: Hub, tmp_path: Path) -> None:
    snapshot = tmp_path / "hf" / "models--me--tiny" / "snapshots" / COMMIT
    snapshot.mkdir(parents=True)
    (snapshot.parents[1] / "refs").mkdir()
    (snapshot.parents[1] / "refs" / "main").write_text(COMMIT)
    (snapshot / "config.json").write_bytes(hub.files[f"{REPO}/config.json"])
    reference = hub_store.reference_of(f"hf:{REPO}")
    assert hub_store.find_folder(reference) is None  # without weights it is no model
    (snapshot / "model.safetensors").write_bytes(WEIGHTS)
    assert hub_store.find_folder(reference) == snapshot
    assert hub_store.find_folder(hub_store.reference_of(f"hf:{REPO}@{LATER}")) is None
    folder = hub_fetch.pull(reference)
    assert hub_store.find_folder(reference) == folder
    assert gets(hub) == [("preprocessor_config.json", None)]  # the others were copied


def test_the_command_line_uses_the_settings_of_the_hub(hub: Hub, tmp_path: Path) -> None:
    environment = {
        **os.environ, "HF_ENDPOINT": hub.url, "SLAMDEPTH_CACHE": str(tmp_path / "mine"),
        "HF_HOME": str(tmp_path), "HF_HUB_OFFLINE": "0", "NO_PROXY": "127.0.0.1",
    }  # fmt: skip
    command = [sys.executable, "-m", "slamdepth", "weights", "pull", f"hf:{REPO}"]

    def call(**settings: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            command, env={**environment, **settings}, capture_output=True, text=True, check=False
        )

    done = call(HF_HUB_OFFLINE="1")
    assert done.returncode == 2
    error = " ".join(done.stderr.split("error: ")[-1].split())
    assert error.startswith((f"{REPO}: HF_HUB_OFFLINE forbids downloads", f"{hub.url} cannot be reached"))
    assert f"put config.json, preprocessor_config.json and model.safetensors of {REPO} into" in error
    done = call()
    assert done.returncode == 0, done.stderr
    assert str(tmp_path / "mine" / "hub" / REPO) in "".join(done.stdout.split())
    assert "licence: not known here" in " ".join(done.stderr.split())
    assert "already in the cache" in call().stderr
