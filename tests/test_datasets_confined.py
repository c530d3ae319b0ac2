# SPDX-License-Identifier: Apache-2.0
"""Sequences stay inside their folder, and archives are not unpacked."""

from __future__ import annotations

import json
import shutil
import tarfile
import zipfile
from pathlib import Path

import pytest
import recordings as made
from command_line import call, slamdepth
from sequences import image_rgb, make_tum, write_image

from slamdepth.datasets import ReadOptions, open_dataset
from slamdepth.errors import DatasetError

FOLLOW = ReadOptions(follow_links=True)


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    path = tmp_path / "private" / "secret.png"
    write_image(path, image_rgb(99))
    return path


@pytest.mark.parametrize("way", ["dots", "absolute", "link", "linked folder", "depth"])
def test_a_list_that_leads_out_of_the_sequence_is_refused_unless_asked(
    tmp_path: Path, outside: Path, way: str
) -> None:
    folder = make_tum(tmp_path / "room")
    if way in ("dots", "absolute", "depth"):
        listed = folder / ("depth.txt" if way == "depth" else "rgb.txt")
        name = str(outside) if way == "absolute" else "../private/secret.png"
        lines = listed.read_text().splitlines()
        lines[-1] = f"{lines[-1].split()[0]} {name}"
        listed.write_text("\n".join(lines) + "\n")
    elif way == "link":
        (folder / "rgb" / "3.png").unlink()
        (folder / "rgb" / "3.png").symlink_to(outside)
    else:
        shutil.move(folder / "rgb", tmp_path / "elsewhere")
        (folder / "rgb").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DatasetError, match=r"leads out of the sequence.*--follow-links") as caught:
        open_dataset(folder)
    assert "\n" not in str(caught.value)
    assert len(open_dataset(folder, options=FOLLOW)) == 4


def test_links_within_a_sequence_and_to_a_whole_one_are_followed(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "room")
    (folder / "rgb" / "3.png").unlink()
    (folder / "rgb" / "3.png").symlink_to("2.png")
    (tmp_path / "link").symlink_to(folder)
    assert len(open_dataset(folder)) == len(open_dataset(tmp_path / "link")) == 4
    (folder / "rgb" / "2.png").unlink()
    (folder / "rgb" / "2.png").symlink_to("3.png")  # a circle
    with pytest.raises(DatasetError, match=r"cannot be found|leads out"):
        open_dataset(folder)


def test_transforms_that_name_images_elsewhere_are_refused_unless_asked(
    tmp_path: Path, outside: Path
) -> None:
    folder = made.make_nerfstudio(tmp_path / "scene")
    values = json.loads((folder / "transforms.json").read_text())
    values["frames"][0]["file_path"] = "../private/secret.png"
    (folder / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match="leads out of the sequence"):
        open_dataset(folder)
    assert len(open_dataset(folder, options=FOLLOW)) == 4


def test_a_colmap_model_that_names_images_elsewhere_is_refused(tmp_path: Path, outside: Path) -> None:
    folder = made.make_colmap(tmp_path / "scene", binary=False)
    text = folder / "sparse" / "0" / "images.txt"
    text.write_text(text.read_text().replace("left/8.png", "../../private/secret.png"))
    with pytest.raises(DatasetError, match="leads out of the sequence"):
        open_dataset(folder)


@pytest.mark.parametrize("layout", ["icl", "record3d", "stray"])
def test_images_that_are_links_out_of_other_layouts_are_refused(tmp_path: Path, layout: str) -> None:
    if layout == "icl":
        folder, _ = made.make_icl_own(tmp_path / "room")
        path = folder / "scene_00_0001.png"
    elif layout == "record3d":
        folder = made.make_record3d(tmp_path / "room", packed=False)
        path = folder / "rgbd" / "1.jpg"
    else:
        folder = made.make_stray(tmp_path / "room")
        path = folder / "rgb.mp4"
    shutil.move(path, tmp_path / path.name)
    path.symlink_to(tmp_path / path.name)
    with pytest.raises(DatasetError, match="leads out of the sequence"):
        open_dataset(folder)
    assert len(open_dataset(folder, options=FOLLOW)) == 4


def test_the_command_line_can_follow_links(tmp_path: Path, outside: Path) -> None:
    folder = make_tum(tmp_path / "room")
    (folder / "rgb" / "0.png").unlink()
    (folder / "rgb" / "0.png").symlink_to(outside)
    refused = call("info", folder)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert "--follow-links" in refused.stderr
    done = call("info", folder, "--follow-links")
    assert done.returncode == 0, done.stderr
    ran = call("run", folder, "--depth", "sensor", "--no-mesh", "-o", tmp_path / "out")
    assert ran.returncode == 2
    assert "--follow-links" in ran.stderr
    assert not (tmp_path / "out").exists()


def test_archives_are_refused_with_the_command_that_unpacks_them(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "my room")
    with zipfile.ZipFile(tmp_path / "my room.zip", "w") as archive:
        archive.write(folder / "rgb.txt", "rgb.txt")
    with tarfile.open(tmp_path / "room.tgz", "w:gz") as packed:
        packed.add(folder / "rgb.txt", "rgb.txt")
    for name, command in (
        ("my room.zip", "unzip '{}' -d 'my room'"),
        ("room.tgz", "mkdir -p room && tar -xf {} -C room"),
    ):
        done = call("info", tmp_path / name)
        assert done.returncode == 2
        assert command.format(tmp_path / name) in done.stderr


def test_info_as_a_process_of_its_own(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "room")
    done = slamdepth("info", folder, "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["layout"] == "tum"
    assert told["frames"] == 4
    assert told["rate_hz"] == pytest.approx(10.0)
    assert told["ground_truth"]["poses"] == 4
    assert told["depth"]["share_known"] > 0.9
    assert told["problems"] == ["only 4 frames"]
    table = slamdepth("info", folder)
    assert "4 frames in 0.30 s, 10.00 Hz" in table.stdout
    assert "problem: only 4 frames" in table.stdout
    missing = slamdepth("info", tmp_path / "absent")
    assert missing.returncode == 2
    assert missing.stderr == f"error: {tmp_path}/absent: no such folder\n"
    helped = slamdepth("info", "--help")
    assert "Example:" in helped.stdout


def test_info_tells_what_is_wrong(tmp_path: Path) -> None:
    folder = make_tum(tmp_path / "room", 30)
    lines = (folder / "rgb.txt").read_text().splitlines()
    late = [
        f"{float(line.split()[0]) + 5 * (i > 20):.6f} {line.split()[1]}" for i, line in enumerate(lines[1:])
    ]
    (folder / "rgb.txt").write_text("\n".join(late) + "\n")
    (folder / "rgb" / "0.png").write_bytes(b"no image")
    write_image(folder / "rgb" / "29.png", image_rgb(0)[..., :1].repeat(3, 2) * 0)
    problems = json.loads(call("info", folder, "--json").stdout)["problems"]
    assert any("1 gaps between frames, the longest of 5.10 s after frame 20" in one for one in problems)
    assert any("1 of 7 frames looked at are bad" in one for one in problems)
    assert any("show nothing, such as frame 29" in one for one in problems)
