# SPDX-License-Identifier: Apache-2.0
"""Names of published models, where they are looked for, and what ``auto`` takes; nothing is loaded."""

from __future__ import annotations

import json
import logging
import subprocess
import sys
from pathlib import Path

import pytest

from slamdepth.config import Config
from slamdepth.depth import hub_store, registry
from slamdepth.depth.card import ModelCard
from slamdepth.depth.hub_card import card_of_config
from slamdepth.depth.hub_input import InputRule, usual_rule
from slamdepth.depth.hub_models import AUTO, BY_NAME, BY_REPO, MODELS
from slamdepth.depth.hub_official import check_name
from slamdepth.depth.metric import with_chosen_model
from slamdepth.depth.registry import chosen_name, depth_model_names, is_depth_model_name
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.types import DepthKind

INDOOR, RELATIVE = "depth-anything-v2-small-metric-indoor", "depth-anything-v2-small"


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(hub_store, "has_extra", lambda: True)
    monkeypatch.setattr(hub_store, "_in_the_hubs_cache", lambda reference: None)
    return tmp_path / "cache"


def put(folder: Path, *, sha256: str | None = None, revision: str = "a" * 40) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text("{}")
    (folder / "model.safetensors").write_bytes(b"weights")
    if sha256 is not None:
        record = {"repo": "org/name", "revision": revision, "sha256": {"model.safetensors": sha256}}
        (folder / hub_store.RECORD).write_text(json.dumps(record))
    return folder


def test_the_table_is_consistent() -> None:
    assert len({model.repo for model in MODELS}) == len(MODELS)
    assert len(BY_NAME) == sum(model.name is not None for model in MODELS)
    for model in MODELS:
        assert (model.revision is None) == (model.sha256 is None)
        if model.revision is not None and model.sha256 is not None:
            assert (len(model.revision), len(model.sha256)) == (40, 64)
        training = model.training
        if model.kind is not DepthKind.METRIC:
            assert (training.focal_px, training.far_m) == (None, None)
    for name in AUTO:
        assert BY_NAME[name].kind is DepthKind.METRIC
        assert "outdoor" not in name


def test_names_of_the_hub(cache: Path) -> None:
    for name in BY_NAME:
        assert is_depth_model_name(name)
        assert hub_store.reference_of(name).repo == BY_NAME[name].repo
    one = hub_store.reference_of("hf:intel/ZOEDEPTH-nyu@main")
    assert (one.repo, one.revision, one.known) == ("Intel/zoedepth-nyu", "main", BY_NAME["zoedepth-nyu"])
    assert one.wanted == "main"
    assert hub_store.reference_of("zoedepth-nyu").wanted == BY_NAME["zoedepth-nyu"].revision
    other = hub_store.reference_of("hf:me/my.model-1")
    assert (other.repo, other.wanted, other.known) == ("me/my.model-1", None, None)
    assert other.folder == cache / "hub" / "me" / "my.model-1"
    for wrong in ("hf:", "hf:name", "hf:a/b/c", "hf:../x", "hf:a/..", "name", "hf:a b/c"):
        with pytest.raises(ConfigError, match="write hf:ORG/NAME"):
            hub_store.reference_of(wrong)
    names = depth_model_names()
    assert names[0] == "auto"
    assert {"dinov2", "sensor", "hf:ORG/NAME", "hf:FOLDER", "onnx:FILE", "mirrored:MODEL"} <= set(names)


def test_a_folder_is_named_by_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    put(tmp_path / "sub" / "mine")
    put(tmp_path / "dinov2")
    for name in ("hf:sub/mine", "hf:./sub/mine", "sub/mine", "./sub/mine", str(tmp_path / "sub" / "mine")):
        folder = hub_store.local_folder(name)
        assert folder is not None
        assert folder.resolve() == tmp_path / "sub" / "mine"
        assert is_depth_model_name(name)
    assert hub_store.local_folder("dinov2") is None  # a folder is not taken for a model's name
    assert hub_store.local_folder("hf:depth-anything/Depth-Anything-V2-Small-hf") is None
    assert hub_store.local_folder("hf:./absent") == Path("absent")
    settings = Config.from_dict({"depth": {"name": "mirrored:hf:sub/mine"}})
    assert f"mirrored:hf:{tmp_path}/sub/mine" in settings.to_yaml()
    assert settings.for_report()["depth"]["name"] == "mirrored:hf:mine"
    for name in ("hf:org/name", "dinov2", "mirrored:dinov2"):
        assert Config.from_dict({"depth": {"name": name}}).for_report()["depth"]["name"] == name
    onnx = Config.from_dict({"depth": {"name": "onnx:nets/a.onnx"}})
    assert onnx.for_report()["depth"]["name"] == "onnx:a.onnx"


def test_absent_models_say_what_to_put_where(cache: Path) -> None:
    for name in ("zoedepth-nyu", "hf:me/mine", RELATIVE):
        with pytest.raises(WeightsError) as error:
            registry.create_depth_model(name)
        text = str(error.value)
        assert f"slamdepth weights pull {name}" in text
        assert "config.json, preprocessor_config.json and model.safetensors of" in text
        assert str(cache / "hub" / hub_store.reference_of(name).repo) in text
        assert "\n" not in text
        with pytest.raises(WeightsError, match="absent"):
            registry.create_depth_model(name, weights=cache / "absent")
    assert f"or depth_anything_v2_vits.pth into {cache}" in text
    with pytest.raises(WeightsError, match=r"no model in the hub's layout"):
        registry.create_depth_model("hf:./absent")


def test_auto_takes_the_best_metric_model_of_the_cache(
    cache: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO, "slamdepth")
    assert chosen_name() == "dinov2"
    assert "depth model 'auto' is 'dinov2': the embedded model; no other metric one" in caplog.text
    for name in ("depth-anything-v2-large", "depth-anything-v2-large-metric-outdoor"):  # relative; outdoors
        put(hub_store.reference_of(name).folder)
    put(cache / "hub" / "me" / "mine")  # what it predicts is not known before it is read
    assert chosen_name() == "dinov2"
    (cache / "depth_anything_v2_metric_hypersim_vits.pth").write_bytes(b"")
    assert chosen_name() == INDOOR
    put(hub_store.reference_of("depth-anything-v2-base-metric-indoor").folder)
    assert chosen_name() == "depth-anything-v2-base-metric-indoor"
    assert "'depth-anything-v2-base-metric-indoor': the best metric model in the cache" in caplog.text
    assert chosen_name(has_weights=True) == "dinov2"
    run = with_chosen_model(Config())
    assert run.depth.name == "depth-anything-v2-base-metric-indoor"
    assert run.depth.max_sigma_log == Config().depth.max_sigma_log
    named = Config.from_dict({"depth": {"name": "dinov2"}})
    assert with_chosen_model(named) is named
    monkeypatch.setattr(hub_store, "has_extra", lambda: False)
    assert chosen_name() == "dinov2"
    assert "without the extra no other can run" in caplog.text


def test_another_revision_than_the_one_asked_for_is_noticed(cache: Path) -> None:
    reference = hub_store.reference_of("hf:me/mine@bbbbbbb")
    folder = put(reference.folder, sha256="", revision="a" * 40)
    with pytest.raises(WeightsError, match="is revision aaaaaaaaaaaa, not bbbbbbb"):
        hub_store.find_folder(reference)
    for name in ("hf:me/mine", "hf:me/mine@aaaaaaa", "hf:me/mine@main"):
        assert hub_store.find_folder(hub_store.reference_of(name)) == folder
    (folder / hub_store.RECORD).write_text("{")
    with pytest.raises(WeightsError, match="not a readable record"):
        hub_store.find_folder(reference)


def test_a_changed_file_is_noticed(cache: Path) -> None:
    folder = put(hub_store.reference_of("hf:me/mine").folder, sha256="0" * 64)
    with pytest.raises(WeightsError, match=r"damaged.*slamdepth weights pull hf:org/name --force"):
        hub_store.checked_sha256(folder / "model.safetensors")


def test_weights_list_shows_models_of_the_hub(cache: Path) -> None:
    put(hub_store.reference_of(RELATIVE).folder)
    put(cache / "hub" / "me" / "mine")
    put(cache / "hub" / "facebook" / "dpt-dinov2-large-nyu")
    entries = {entry.name: entry for entry in hub_store.hub_entries()}
    assert set(BY_NAME) | {"hf:me/mine", "hf:facebook/dpt-dinov2-large-nyu"} == set(entries)
    assert [name for name, entry in entries.items() if entry.state == "cached"] == [
        RELATIVE, "hf:facebook/dpt-dinov2-large-nyu", "hf:me/mine",
    ]  # fmt: skip
    assert (entries[RELATIVE].size_bytes, entries[RELATIVE].licence) == (7, "Apache-2.0")
    assert entries["hf:me/mine"].licence == hub_store.UNKNOWN


@pytest.mark.parametrize(
    ("height", "width", "expected"),
    [(480, 640, (518, 686)), (640, 480, (686, 518)), (240, 320, (518, 686)), (375, 1242, (518, 1722))],
)
def test_depth_anything_has_the_input_size_of_its_authors(
    height: int, width: int, expected: tuple[int, int]
) -> None:
    assert usual_rule("depth_anything").size_of(height, width) == expected


def test_sizes_of_models_without_one() -> None:
    rule = InputRule(None, multiple=32)
    assert rule.size_of(480, 640) == (480, 640)
    assert rule.size_of(960, 1280, native=(480, 640)) == (480, 640)
    assert rule.size_of(500, 500, native=(480, 640)) == (544, 544)


def test_zoedepth_says_its_range_itself() -> None:
    bins = [{"min_depth": 0.001, "max_depth": 10.0}]
    config = {"model_type": "zoedepth", "bin_configurations": bins}
    bounded = {**config, "bin_centers_type": "normed"}
    rule = usual_rule("zoedepth")
    card = card_of_config("zoedepth-nyu-kitti", config, rule, "x", BY_NAME["zoedepth-nyu-kitti"])
    assert (card.range_m, card.native_focal_px, card.kind) == (None, None, DepthKind.METRIC)
    assert isinstance(card, ModelCard)
    assert card_of_config("mine", bounded, rule, "x").range_m == (0.001, 10.0)
    kitti = BY_REPO["intel/zoedepth-kitti"]
    with pytest.raises(WeightsError, match="up to 10 m, but 'x' was trained up to 80 m"):
        card_of_config("x", bounded, rule, "x", kitti)
    with pytest.raises(WeightsError, match="lacks the range"):
        card_of_config("mine", {"model_type": "zoedepth", "bin_centers_type": "normed"}, rule, "x")


def test_official_files_are_told_apart_by_their_names() -> None:
    indoor, relative = BY_NAME[INDOOR], BY_NAME[RELATIVE]
    check_name(Path("depth_anything_v2_metric_hypersim_vits.pth"), INDOOR, indoor)
    check_name(Path("mine.pth"), RELATIVE, relative)
    for name in ("depth_anything_v2_vits.pth", "metric_vkitti_vits.pth", "hypersim_vits.pth", "model.pth"):
        with pytest.raises(WeightsError, match=r"takes depth_anything_v2_metric_hypersim_vits\.pth"):
            check_name(Path(name), INDOOR, indoor)
    with pytest.raises(WeightsError, match="named as a metric model"):
        check_name(Path("depth_anything_v2_metric_hypersim_vits.pth"), RELATIVE, relative)


def test_nothing_imports_transformers_before_a_model_of_it_is_asked_for() -> None:
    code = (
        "import sys, slamdepth; from typer.testing import CliRunner\n"
        "from slamdepth.cli.app import app\n"
        "assert CliRunner().invoke(app, ['run', '--help']).exit_code == 0\n"
        "slamdepth.create_depth_model('sensor'); import slamdepth.depth.model\n"
        "assert not {'transformers', 'huggingface_hub'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
