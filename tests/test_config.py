# SPDX-License-Identifier: Apache-2.0
"""Settings: strict, frozen, and the same after a trip through a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from slamdepth.config import Config, merge
from slamdepth.errors import ConfigError


def test_defaults_are_valid_and_frozen() -> None:
    config = Config()
    assert config == Config.from_dict({})
    with pytest.raises(ValidationError):
        config.seed = 3  # type: ignore[misc]
    with pytest.raises(ValidationError):
        config.features.count = 3  # type: ignore[misc]


def test_every_setting_says_what_it_is() -> None:
    for name, section in Config.model_fields.items():
        inner = getattr(section.annotation, "model_fields", None)
        for key, field in (inner or {name: section}).items():
            assert field.description, f"{name}.{key}"


@pytest.mark.parametrize(
    ("values", "named", "allowed"),
    [
        ({"sed": 1}, "unknown setting 'sed'", "seed"),
        ({"features": {"cuont": 500}}, "unknown setting 'features.cuont'", "count"),
        ({"loops": {"enable": True}}, "unknown setting 'loops.enable'", "enabled, min_gap, min_inliers"),
    ],
)
def test_an_unknown_setting_is_named_with_the_allowed_ones(
    values: dict[str, Any], named: str, allowed: str
) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.from_dict(values, origin="my.yaml")
    message = str(caught.value)
    assert message.startswith("my.yaml: ")
    assert named in message
    assert allowed in message.split("allowed here:")[1]
    assert "\n" not in message
    assert caught.value.exit_code == 2


@pytest.mark.parametrize(
    ("values", "named"),
    [
        ({"features": {"count": 1}}, "features.count"),
        ({"features": {"scale_factor": 1.0}}, "features.scale_factor"),
        ({"tracking": {"keyframe_overlap": 1.5}}, "tracking.keyframe_overlap"),
        ({"device": "tpu"}, "device"),
        ({"odometry": "dso"}, "odometry"),
        ({"seed": -1}, "seed"),
        ({"seed": "many"}, "seed"),
        ({"features": 3}, "features"),
        ({"map": {"voxel_size_m": 0}}, "map.voxel_size_m"),
    ],
)
def test_a_value_out_of_range_is_named(values: dict[str, Any], named: str) -> None:
    with pytest.raises(ConfigError, match=f"setting '{named}': .* \\(got ") as caught:
        Config.from_dict(values)
    assert "\n" not in str(caught.value)


def test_round_trip_through_yaml(tmp_path: Path) -> None:
    config = Config.from_dict({"seed": 7, "odometry": "kiss-icp", "depth": {"max_m": 4.5}})
    path = tmp_path / "config.yaml"
    path.write_text(config.to_yaml())
    assert Config.from_yaml(path) == config


def test_overrides_lie_over_the_file(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("seed: 7\nfeatures:\n  count: 500\n  levels: 4\n")
    config = Config.from_yaml(path, {"features": {"count": 800}})
    assert (config.seed, config.features.count, config.features.levels) == (7, 800, 4)


def test_an_empty_file_means_the_defaults(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text("# nothing\n")
    assert Config.from_yaml(path) == Config()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("- a\n- b\n", "found a list"),
        ("seed: [1\n", "not valid YAML"),
        ("fast", "found a str"),
    ],
)
def test_a_malformed_file_is_one_line(tmp_path: Path, text: str, says: str) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=says) as caught:
        Config.from_yaml(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read"):
        Config.from_yaml(tmp_path / "absent.yaml")
    with pytest.raises(ConfigError, match="cannot read"):
        Config.from_yaml(tmp_path)
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not valid YAML"):
        Config.from_yaml(binary)


trees = st.recursive(
    st.integers(), lambda inner: st.dictionaries(st.sampled_from("abcd"), inner, max_size=3), max_leaves=8
)
dicts = st.dictionaries(st.sampled_from("abcd"), trees, max_size=4)


@given(dicts, dicts)
def test_merge_lays_one_over_the_other(base: dict[str, Any], over: dict[str, Any]) -> None:
    before = (repr(base), repr(over))
    merged = merge(base, over)
    assert (repr(base), repr(over)) == before
    assert merge(merged, over) == merged
    assert merge(base, {}) == base
    assert merge({}, over) == over
    assert set(merged) == set(base) | set(over)
    for key in set(base) - set(over):
        assert merged[key] == base[key]
    for key, value in over.items():
        if not isinstance(value, dict):
            assert merged[key] == value
