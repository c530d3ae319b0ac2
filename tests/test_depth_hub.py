# SPDX-License-Identifier: Apache-2.0
"""Models in the hub's layout: tiny random ones of every family, saved by transformers itself."""

from __future__ import annotations

import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

transformers = pytest.importorskip("transformers", reason="needs pip install 'slamdepth[hub]'")

from depth_frames import frame_of  # noqa: E402
from hub_folders import FAMILIES, save_tiny  # noqa: E402
from safetensors.torch import load_file, save_file  # noqa: E402

from slamdepth.depth import hub_store  # noqa: E402
from slamdepth.depth.base import DepthModel  # noqa: E402
from slamdepth.depth.hub import HubDepth  # noqa: E402
from slamdepth.depth.hub_input import read_rule, restored  # noqa: E402
from slamdepth.depth.metric import check_metric  # noqa: E402
from slamdepth.depth.registry import create_depth_model  # noqa: E402
from slamdepth.errors import ConfigError, WeightsError  # noqa: E402
from slamdepth.io import sha256_of  # noqa: E402
from slamdepth.types import DepthKind  # noqa: E402

INDOOR, RELATIVE = "depth-anything-v2-small-metric-indoor", "depth-anything-v2-small"
STATED = {"kind": "metric depth", "input_size": [48, 64], "focal_px": 60.0, "licence": "mine"}


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Gives the folder and the network of a family; made once, not to be changed."""
    made: dict[str, tuple[Path, torch.nn.Module]] = {}

    def folder_of(family: str) -> tuple[Path, torch.nn.Module]:
        if family == "tipsv2_dpt" and family not in transformers.CONFIG_MAPPING:
            pytest.skip(f"transformers {transformers.__version__} has no {family}")
        if family not in made:
            folder = tmp_path_factory.mktemp("hub") / family
            made[family] = folder, save_tiny(folder, family)
        return made[family]

    return folder_of


@pytest.fixture
def cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    monkeypatch.setenv("SLAMDEPTH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def copied(folder: Path, target: Path, **stated: Any) -> Path:
    """A copy of a model's folder by links, and a ``slamdepth.json`` with ``stated``, if any."""
    target.mkdir(parents=True)
    for file in folder.iterdir():
        (target / file.name).symlink_to(file)
    if stated:
        (target / "slamdepth.json").write_text(json.dumps(stated))
    return target


def in_cache(folder: Path, name: str) -> Path:
    """Put a model's folder where a short name looks for it."""
    return copied(folder, hub_store.reference_of(name).folder)


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_predicts_what_its_network_computes(family: str, tiny: Any, tmp_path: Path) -> None:
    folder, network = tiny(family)
    stated = STATED if family in ("dpt", "dpt_dinov2", "glpn") else {}
    model = create_depth_model(f"hf:{copied(folder, tmp_path / family, **stated)}")
    assert isinstance(model, HubDepth)
    assert isinstance(model, DepthModel)
    assert model.name == f"hf:{family}"
    assert model.kind is (DepthKind.AFFINE_INVERSE_DEPTH if family == "relative" else DepthKind.METRIC)
    assert model.weights[0].sha256 == sha256_of(folder / "model.safetensors")
    frame = frame_of()
    prediction = model.predict(frame)
    assert prediction.values.shape == (48, 64)
    assert prediction.values.dtype == np.float32
    assert np.ptp(prediction.values) > 0
    np.testing.assert_array_equal(prediction.values, model.predict(frame).values)

    config_type = json.loads((folder / "config.json").read_text())["model_type"]
    prepared = read_rule(folder, config_type).prepare(frame.image_rgb, (48, 64))
    with torch.inference_mode():
        expected = restored(network(prepared.pixels).predicted_depth, prepared, 48, 64).numpy()
    if family == "depth_pro":
        expected = 1 / np.clip(expected, 1e-4, 1e4)
    values, _ = model.infer(frame.image_rgb)
    np.testing.assert_allclose(values, expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("family", ["dpt", "dpt_dinov2", "zoedepth", "glpn"])
@pytest.mark.parametrize(("width", "height"), [(80, 60), (60, 80), (160, 120)])
def test_images_are_prepared_as_transformers_does(family: str, width: int, height: int, tiny: Any) -> None:
    folder, _ = tiny(family)
    name = {"zoedepth": "ZoeDepth", "glpn": "GLPN"}.get(family, "DPT") + "ImageProcessor"
    processor = getattr(transformers, f"{name}Pil", None) or getattr(transformers, name)
    settings = json.loads((folder / "preprocessor_config.json").read_text())
    rows = np.linspace(0, 255, height)[:, None, None] * np.ones((1, width, 3))
    image = (rows * 0.7 + np.linspace(0, 70, width)[None, :, None]).clip(0, 255).astype(np.uint8)
    theirs = processor(**settings)(images=image, return_tensors="np")["pixel_values"][0]
    config_type = json.loads((folder / "config.json").read_text())["model_type"]
    ours = read_rule(folder, config_type).prepare(image, None).pixels[0].numpy()
    assert ours.shape == theirs.shape
    np.testing.assert_allclose(ours, theirs, atol=0.02)  # they round resized images to 8 bits


def test_a_short_name_has_the_facts_of_the_table(tiny: Any, cache: Path) -> None:
    in_cache(tiny("metric")[0], INDOOR)
    model = create_depth_model(INDOOR)
    assert isinstance(model, HubDepth)
    assert (model.name, model.card.native_size, model.card.range_m) == (INDOOR, (518, 686), (0.0, 20.0))
    assert model.card.native_focal_px == pytest.approx(596.1, abs=0.1)
    assert (model.card.licence, model.card.trained_on) == ("Apache-2.0", "Hypersim")
    assert model.weights[0].name == "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf"
    once, twice = model.predict(frame_of(focal=50.0)).values, model.predict(frame_of(focal=100.0)).values
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-5)
    by_repo = create_depth_model(f"hf:{model.weights[0].name}")
    np.testing.assert_array_equal(by_repo.predict(frame_of(focal=50.0)).values, once)
    mirrored = create_depth_model(f"mirrored:{INDOOR}")
    assert mirrored.predict(frame_of()).values.shape == (48, 64)


def test_depth_of_the_training_camera_is_taken_as_predicted(tiny: Any, tmp_path: Path) -> None:
    folder = copied(tiny("metric")[0], tmp_path / "mine", **{**STATED, "input_size": [70, 98]})
    model = HubDepth.load(str(folder))
    assert model.name == "hf:mine"
    values, size = model.infer(frame_of().image_rgb)
    assert size == (70, 98)  # the focal length there is 60 * sqrt(70 * 98 / (48 * 64)) px
    expected = values * np.sqrt(70 * 98 / (48 * 64))
    np.testing.assert_allclose(model.predict(frame_of(focal=60.0)).values, expected, rtol=1e-5)


def test_depth_pro_scales_with_the_focal_length_in_image_widths(tiny: Any) -> None:
    model = HubDepth.load(f"hf:{tiny('depth_pro')[0]}")
    values, _ = model.infer(frame_of().image_rgb)
    expected = values * (60.0 / 64)
    np.testing.assert_allclose(model.predict(frame_of(focal=60.0)).values, expected, rtol=1e-5)
    np.testing.assert_allclose(model.predict(frame_of(focal=60.0, focal_y=90.0)).values, expected, rtol=1e-5)


def test_an_unknown_focal_length_is_said_in_the_log(tiny: Any, caplog: pytest.LogCaptureFixture) -> None:
    model = HubDepth.load(f"hf:{tiny('metric')[0]}")
    assert "focal length it was trained at is not known" in caplog.text
    once = model.predict(frame_of(focal=50.0)).values
    np.testing.assert_array_equal(model.predict(frame_of(focal=100.0)).values, once)


def test_relative_is_never_taken_for_metric(tiny: Any, cache: Path, tmp_path: Path) -> None:
    in_cache(tiny("relative")[0], INDOOR)
    with pytest.raises(WeightsError, match=r"config\.json says affine inverse depth, the table .* metric"):
        create_depth_model(INDOOR)
    folder = copied(tiny("relative")[0], tmp_path / "mine", **STATED)
    with pytest.raises(WeightsError, match=r"says affine inverse depth, slamdepth\.json says metric depth"):
        create_depth_model(f"hf:{folder}")
    with pytest.raises(ConfigError, match="predicts affine inverse depth; tracking needs metres"):
        check_metric(create_depth_model(f"hf:{tiny('relative')[0]}"))


def test_a_model_of_another_range_is_noticed(tiny: Any, cache: Path) -> None:
    in_cache(tiny("outdoor")[0], INDOOR)
    with pytest.raises(WeightsError, match=r"up to 80 m, but '.*indoor' was trained up to 20 m"):
        create_depth_model(INDOOR)


def test_without_a_kind_a_model_is_refused(tiny: Any, tmp_path: Path) -> None:
    with pytest.raises(WeightsError, match=r"write slamdepth\.json there with at least") as error:
        create_depth_model(f"hf:{tiny('dpt')[0]}")
    assert "\n" not in str(error.value)
    stated = copied(tiny("dpt")[0], tmp_path / "affine", kind="affine depth", input_size=[64, 64])
    assert create_depth_model(f"hf:{stated}").kind is DepthKind.AFFINE_DEPTH
    wrong = copied(tiny("dpt")[0], tmp_path / "wrong", kind="metres")
    with pytest.raises(WeightsError, match=r"slamdepth\.json: kind"):
        create_depth_model(f"hf:{wrong}")
    named = copied(tiny("dpt_dinov2")[0], tmp_path / "dpt-dinov2-small-nyu")
    model = create_depth_model(f"hf:{named}")
    assert isinstance(model, HubDepth)
    assert (model.kind, model.card.trained_on) == (DepthKind.METRIC, "NYU Depth v2")


@pytest.mark.parametrize(
    ("model_type", "why"), [("prompt_depth_anything", "completes the depth"), ("chmv2", "height of trees")]
)
def test_models_of_something_else_are_refused(model_type: str, why: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": model_type}))
    (tmp_path / "preprocessor_config.json").write_text(
        json.dumps({"size": 64, "image_mean": [0.5] * 3, "image_std": [0.5] * 3})
    )
    with pytest.raises(WeightsError, match=why):
        create_depth_model(f"hf:{tmp_path}")


def test_missing_and_misshapen_tensors_are_named(
    tiny: Any, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, _ = tiny("metric")
    tensors = load_file(str(folder / "model.safetensors"))

    def with_tensors(name: str, changed: dict[str, torch.Tensor]) -> str:
        target = copied(folder, tmp_path / name)
        (target / "model.safetensors").unlink()
        save_file(changed, str(target / "model.safetensors"))
        return f"hf:{target}"

    key = "head.conv2.weight"
    less = {name: value for name, value in tensors.items() if name != key}
    with pytest.raises(WeightsError, match=rf"1 missing \(first: {key}\)") as error:
        create_depth_model(with_tensors("less", less))
    assert "\n" not in str(error.value)
    with pytest.raises(WeightsError, match=rf"1 misshapen \(first: {key}\)"):
        create_depth_model(with_tensors("other", {**less, key: torch.zeros(2, 2)}))
    # The first fusion has nothing to add: published files lack its residual unit.
    unused = {n: v for n, v in tensors.items() if "fusion_stage.layers.0.residual_layer1" not in n}
    assert len(unused) < len(tensors)
    extra = create_depth_model(with_tensors("unused", {**unused, "extra": torch.zeros(2)}))
    assert "1 tensors are not used (first: extra)" in caplog.text
    expected = create_depth_model(f"hf:{folder}").predict(frame_of()).values
    np.testing.assert_array_equal(extra.predict(frame_of()).values, expected)


def test_pytorch_files_and_divided_ones_are_read_too(tiny: Any, tmp_path: Path) -> None:
    folder, network = tiny("metric")
    expected = create_depth_model(f"hf:{folder}").predict(frame_of()).values
    one = copied(folder, tmp_path / "bin")
    (one / "model.safetensors").unlink()
    torch.save(network.state_dict(), one / "pytorch_model.bin")
    np.testing.assert_array_equal(create_depth_model(f"hf:{one}").predict(frame_of()).values, expected)
    torch.save(torch.nn.Linear(2, 2), one / "pytorch_model.bin")
    with pytest.raises(WeightsError, match="more than tensors and plain values, which is never run"):
        create_depth_model(f"hf:{one}")

    parts = copied(folder, tmp_path / "parts")
    (parts / "model.safetensors").unlink()
    network.save_pretrained(parts, max_shard_size="40KB")
    assert len(list(parts.glob("model-*.safetensors"))) > 1
    divided = create_depth_model(f"hf:{parts}")
    assert len(divided.weights) == len(list(parts.glob("model-*.safetensors")))
    np.testing.assert_array_equal(divided.predict(frame_of()).values, expected)
    next(parts.glob("model-*.safetensors")).unlink()
    with pytest.raises(WeightsError, match="this part of the weights is missing"):
        create_depth_model(f"hf:{parts}")


@pytest.mark.parametrize("family", ["metric", "dpt"])
def test_configurations_of_earlier_versions_are_read(family: str, tiny: Any, tmp_path: Path) -> None:
    folder = copied(tiny(family)[0], tmp_path / family, **STATED)
    expected = create_depth_model(f"hf:{folder}").predict(frame_of()).values
    config = json.loads((folder / "config.json").read_text())
    config.pop("dtype", None)
    config |= {"torch_dtype": "float32", "transformers_version": "4.41.0", "_commit_hash": None}
    config |= {"backbone": None, "use_pretrained_backbone": False, "use_timm_backbone": False}
    (folder / "config.json").unlink()
    (folder / "config.json").write_text(json.dumps(config))
    np.testing.assert_array_equal(create_depth_model(f"hf:{folder}").predict(frame_of()).values, expected)


def test_broken_folders_are_one_line(tiny: Any, tmp_path: Path) -> None:
    def refused(match: str) -> None:
        with pytest.raises(WeightsError, match=match) as error:
            create_depth_model(f"hf:{tmp_path}")
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 600

    refused(r"no model in the hub's layout: it has no config\.json")
    (tmp_path / "config.json").write_text("{")
    refused(r"config\.json: not readable as JSON")
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    refused(r"has no preprocessor_config\.json")
    (tmp_path / "preprocessor_config.json").write_text('{"size": {"height": 0, "width": 4}}')
    refused(r"preprocessor_config\.json: not readable as the settings of an image processor")
    (tmp_path / "preprocessor_config.json").write_text(
        '{"size": 64, "image_mean": [0.5, 0.5, 0.5], "image_std": [0.5, 0.5, 0.5]}'
    )
    (tmp_path / "slamdepth.json").write_text(json.dumps(STATED))
    refused(r"has no weights: none of model\.safetensors")
    (tmp_path / "model.safetensors").symlink_to(tiny("metric")[0] / "model.safetensors")
    refused("builds no depth network of type 'bert' from it")
    (tmp_path / "config.json").write_text('{"model_type": "no such type"}')
    refused("builds no depth network of type 'no such type' from it")
    with pytest.raises(ConfigError, match="names its folder already"):
        create_depth_model(f"hf:{tmp_path}", weights=tmp_path)


def test_without_the_extra_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hub_store, "has_extra", lambda: False)
    with pytest.raises(
        ConfigError, match=r"needs transformers: install it with pip install 'slamdepth\[hub\]'"
    ):
        create_depth_model(RELATIVE)


def test_loading_leaves_the_settings_of_transformers_alone(tiny: Any) -> None:
    theirs = transformers.utils.logging
    theirs.set_verbosity(logging.ERROR)
    create_depth_model(f"hf:{tiny('relative')[0]}")
    assert theirs.get_verbosity() == logging.ERROR
    assert theirs.is_progress_bar_enabled()
