# SPDX-License-Identifier: Apache-2.0
"""The package: its public names, and what importing it costs."""

from __future__ import annotations

import inspect
import logging
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from importlib import metadata
from pathlib import Path

import pytest

import slamdepth

HEAVY = (
    "torch",
    "open3d",
    "gtsam",
    "numba",
    "cv2",
    "evo",
    "matplotlib",
    "kiss_icp",
    "trimesh",
    "viser",
    "scipy",
    "onnx",
    "pydantic",
)


def loaded_by(code: str) -> set[str]:
    """Top-level modules a fresh interpreter has after ``code``."""
    script = f"import sys\n{code}\nsys.stderr.write(' '.join({{m.split('.')[0] for m in sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stderr.split())


def test_every_public_name_can_be_had() -> None:
    for name in slamdepth.__all__:
        assert getattr(slamdepth, name) is not None, name
    assert set(slamdepth.__all__) <= set(dir(slamdepth))
    assert set(slamdepth._HOME) == set(slamdepth.__all__) - {"__version__"}


def test_the_promised_names_are_public() -> None:
    promised = {"Tracker", "Frame", "Camera", "Config", "Trajectory", "Reconstruction", "StepResult"}
    promised |= {"open_dataset", "create_depth_model", "create_tracker", "SlamdepthError"}
    promised |= {"run", "RunResult", "Prepared", "Mesh", "Dataset"}
    assert promised <= set(slamdepth.__all__)


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'Traker'"):
        _ = slamdepth.Traker


def public_functions() -> Iterator[tuple[str, Callable[..., object]]]:
    """Public functions, and methods of public classes, by name."""
    for name in slamdepth.__all__:
        value = getattr(slamdepth, name)
        if inspect.isfunction(value):
            yield name, value
        for attribute, member in vars(value).items() if isinstance(value, type) else ():
            function = getattr(member, "fget", None) or getattr(member, "__func__", member)
            if inspect.isfunction(function) and (attribute == "__init__" or not attribute.startswith("_")):
                yield f"{name}.{attribute}", function


def test_public_methods_take_and_return_public_types() -> None:
    for name, function in public_functions():
        for annotation in inspect.get_annotations(function).values():
            for word in re.findall(r"\b[A-Z]\w+", str(annotation)):
                kind = vars(sys.modules[function.__module__]).get(word)
                if isinstance(kind, type) and kind.__module__.startswith("slamdepth."):
                    assert word in slamdepth.__all__, f"{name} takes or returns {word}"


def test_every_error_is_public() -> None:
    from slamdepth import errors

    tree = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert tree <= set(slamdepth.__all__)


def test_importing_the_package_loads_nothing() -> None:
    loaded = loaded_by("import slamdepth")
    assert not loaded & {*HEAVY, "numpy", "yaml", "typer", "rich"}


def test_help_loads_nothing_heavy() -> None:
    code = """
sys.argv = ["slamdepth", "--help"]
from slamdepth.cli import main
try:
    main()
except SystemExit as leaving:
    assert leaving.code == 0
"""
    assert not loaded_by(code) & {*HEAVY, "numpy"}


def test_the_value_types_load_numpy_alone() -> None:
    assert not loaded_by("from slamdepth import Frame, Camera, SlamdepthError") & set(HEAVY)


def test_the_library_is_silent_unless_asked() -> None:
    handlers = logging.getLogger("slamdepth").handlers
    assert any(isinstance(handler, logging.NullHandler) for handler in handlers)


def test_the_version_is_one() -> None:
    assert metadata.version("slamdepth") == slamdepth.__version__


def test_the_package_says_it_is_typed() -> None:
    assert (Path(slamdepth.__file__).parent / "py.typed").is_file()


def test_only_the_command_line_prints() -> None:
    root = Path(slamdepth.__file__).parent
    for path in root.rglob("*.py"):
        if "cli" not in path.relative_to(root).parts:
            assert not re.search(r"^\s*print\(", path.read_text(encoding="utf-8"), re.MULTILINE), path


def test_every_file_names_its_licence() -> None:
    for ending, comment in (("py", "# {}"), ("j2", "{{#- {} -#}}")):
        for path in Path(slamdepth.__file__).parent.rglob(f"*.{ending}"):
            first = path.read_text(encoding="utf-8").partition("\n")[0]
            assert first == comment.format("SPDX-License-Identifier: Apache-2.0"), path
