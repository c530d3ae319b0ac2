# SPDX-License-Identifier: Apache-2.0
"""``camera.yaml``: exact round trips, and errors that name file, key and the allowed keys."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from wide_world import LENSES, wide_camera

from slamdepth.calibration import WideLens
from slamdepth.calibration.plausible import check_plausible
from slamdepth.errors import CameraError
from slamdepth.io import write_camera
from slamdepth.types import Camera

RELAXED = settings(
    deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=60
)
GOOD = "width: 640\nheight: 480\nfx: 500\nfy: 501.5\ncx: 320\ncy: 240\n"


def test_optional_keys_have_defaults(tmp_path: Path) -> None:
    path = tmp_path / "camera.yaml"
    path.write_bytes(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode())
    camera = Camera.from_file(path)
    assert camera == Camera(640, 480, 500.0, 501.5, 320.0, 240.0)
    assert camera.depth_factor == 5000.0
    assert not camera.is_distorted


positive = st.floats(1e-3, 1e5)
anything = st.floats(-1e5, 1e5)


@RELAXED
@given(
    camera=st.builds(
        Camera,
        width=st.integers(1, 10000),
        height=st.integers(1, 10000),
        fx=positive,
        fy=positive,
        cx=anything,
        cy=anything,
        distortion=st.one_of(st.tuples(*[anything] * 5), st.tuples(*[anything] * 8)),
        depth_factor=positive,
        fps=positive,
    )
)
def test_round_trip(tmp_path: Path, camera: Camera) -> None:
    """To the bit, or refused by name: never another camera."""
    path = tmp_path / "camera.yaml"
    write_camera(path, camera)
    refusal = refused(camera)
    if refusal is None:
        assert Camera.from_file(path) == camera
    else:
        with pytest.raises(CameraError) as caught:
            Camera.from_file(path)
        assert str(caught.value) == f"{path}: {refusal}"


def refused(camera: Camera) -> str | None:
    try:
        check_plausible(camera)
    except CameraError as error:
        return str(error)
    return None


@st.composite
def real_cameras(draw: st.DrawFn) -> Camera:
    width, height = draw(st.integers(1, 10000)), draw(st.integers(1, 10000))
    fx = draw(st.floats(0.8, 2.3)) * max(width, height)
    fy = fx * draw(st.floats(1.0, 1.3))
    middle, weak = st.floats(0.45, 0.55), st.floats(0.0, 0.1)
    return Camera(
        width, height, fx, fy, draw(middle) * width - 0.5, draw(middle) * height - 0.5,
        (draw(weak), draw(weak), draw(weak) / 100, -draw(weak) / 100, draw(weak)),
        draw(positive), draw(positive),
    )  # fmt: skip


@RELAXED
@given(real_cameras())
def test_round_trip_of_plausible_cameras(tmp_path: Path, camera: Camera) -> None:
    write_camera(tmp_path / "camera.yaml", camera)
    notes: list[str] = []
    assert Camera.from_file(tmp_path / "camera.yaml", notes) == camera
    assert notes == []


@pytest.mark.parametrize("lens", LENSES.values(), ids=lambda lens: lens.model)
def test_round_trip_of_wide_lenses(tmp_path: Path, lens: WideLens) -> None:
    camera = replace(wide_camera(640, lens), depth_factor=1000.0)
    write_camera(tmp_path / "camera.yaml", camera)
    notes: list[str] = []
    assert Camera.from_file(tmp_path / "camera.yaml", notes) == camera
    assert notes == []


def test_round_trip_of_eight_coefficients(tmp_path: Path) -> None:
    camera = Camera(640, 480, 500.0, 501.0, 320.0, 240.0, (0.4, -0.3, 1e-3, -1e-3, 0.1, 0.5, -0.2, 0.05))
    write_camera(tmp_path / "camera.yaml", camera)
    assert Camera.from_file(tmp_path / "camera.yaml") == camera


@pytest.mark.parametrize(
    "text",
    [
        GOOD + "---\n",
        GOOD + "...\n",
        "---\n" + GOOD + "---\n---\n",
        GOOD + "---\n" + GOOD,
        GOOD.replace("500", "5e2").replace("501.5", "5015e-1"),
        GOOD.replace("500", '"500"').replace("640", "'640'").replace("480", "480.0"),
        GOOD + "distortion: []\n",
        GOOD + "distortion:\n",
        GOOD + 'distortion: ["0", 0e-5, 0.0, "0.0", 0]\n',
    ],
)
def test_yaml_is_read_as_tools_write_it(tmp_path: Path, text: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    notes: list[str] = []
    assert Camera.from_file(path, notes) == Camera(640, 480, 500.0, 501.5, 320.0, 240.0)
    assert notes == []


@given(st.floats(1e-5, 0.1), st.sampled_from(["{:g}", "{:.17g}", "{:e}", '"{:e}"', "'{:g}'"]))
def test_numbers_are_read_in_any_notation(
    tmp_path_factory: pytest.TempPathFactory, value: float, form: str
) -> None:
    path = tmp_path_factory.mktemp("camera") / "camera.yaml"
    text = form.format(value)
    path.write_text(GOOD + f"distortion: [{text}, 0, 0, 0, 0]\n")
    assert Camera.from_file(path).distortion[0] == float(text.strip("\"'"))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (GOOD + "---\n" + GOOD.replace("500", "600"), "holds 2 documents that differ; leave one camera"),
        (GOOD + "---\nnothing\n", "holds 2 documents that differ"),
        (
            GOOD + "focal: 3\n",
            "unknown key 'focal'; allowed are width, height, fx, fy, cx, cy, model, dist",
        ),
        (GOOD + "3: 3\n", "unknown key 3; allowed are width"),
        (GOOD.replace("fy: 501.5\n", ""), "key fy missing; needed are width, height, fx, fy, cx, cy"),
        ("width: 640\nheight: 480\n", "keys fx, fy, cx, cy missing"),
        (GOOD.replace("640", "640.5"), "key 'width' must be a whole number of pixels, found 640.5"),
        (GOOD.replace("640", "true"), "key 'width' must be a whole number"),
        (GOOD.replace("501.5", "wide"), "key 'fy' must be a number such as 500.0, found 'wide'"),
        (GOOD.replace("501.5", "yes"), "key 'fy' must be a number"),
        (GOOD.replace("501.5", "null"), "key 'fy' must be a number"),
        (GOOD.replace("501.5", "-1"), "fx and fy must be positive"),
        (GOOD.replace("501.5", ".nan"), "must be finite"),
        (GOOD.replace("501.5", "1" + "0" * 400), "key 'fy' is out of range"),
        (GOOD.replace("640", "0"), "width and height must be positive"),
        (GOOD + "distortion: [1, 2, 3, 4]\n", "key 'distortion' must be five numbers [k1, k2, p1, p2, k3]"),
        (GOOD + "distortion: [1, 2, 3, 4, x]\n", "key 'distortion' must be a number"),
        (GOOD + "model: wide\n", "key 'model' must be one of brown_conrady, fisheye, double_sphere, exten"),
        (GOOD + "model: fisheye\n", "the model 'fisheye' must be 4 numbers [k1, k2, k3, k4], found None"),
        (GOOD + "model: fov\ndistortion: [x]\n", "key 'distortion' must be a number"),
        (GOOD + "model: fisheye\ndistortion: [-2, 0, 0, 0]\n", "less than half way to an edge"),
        (GOOD + "model: fisheye\ndistortion: [-99, 0, 0, 0]\n", "sees nothing: check the order"),
        (GOOD + "depth_factor: 0\n", "depth_factor and fps must be positive"),
        (GOOD + "fx: 501\n", "key 'fx' is given twice"),
        (GOOD.replace("320", "3000"), "cx 3000 lies outside the image, whose width is 640"),
        (GOOD.replace("240", "-1"), "cy -1 lies outside the image, whose height is 480"),
        (
            GOOD + "distortion: [50, .2, 0, 0, 100]\n",
            "distortion [50, 0.2, 0, 0, 100] (k1 k2 p1 p2 k3) cannot be un",
        ),
        ("", "expected lines 'key: value'"),
        ("- 1\n", "expected lines 'key: value'"),
        ("width: [\n", "not valid YAML"),
        ("width: 2001-99-99\n", "not valid YAML"),
    ],
)
def test_errors_name_file_and_key(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    with pytest.raises(CameraError) as caught:
        Camera.from_file(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert what in message
    assert "\n" not in message


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match=r"none\.yaml: cannot be read"):
        Camera.from_file(tmp_path / "none.yaml")


@RELAXED
@given(
    st.one_of(st.binary(max_size=80), st.text(max_size=80).map(lambda text: text.encode("utf-8", "replace")))
)
def test_garbage_is_a_camera_error(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "camera.yaml"
    path.write_bytes(data)
    with pytest.raises(CameraError):
        Camera.from_file(path)


def test_what_is_unusual_is_logged_unless_it_is_noted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_camera(tmp_path / "wide.yaml", Camera(640, 480, 100.0, 100.0, 320.0, 240.0))
    notes: list[str] = []
    Camera.from_file(tmp_path / "wide.yaml", notes)
    assert not caplog.records
    Camera.from_file(str(tmp_path / "wide.yaml"))
    assert [record.getMessage() for record in caplog.records] == notes
    assert "horizontal view" in notes[0]
