# SPDX-License-Identifier: Apache-2.0
"""Parts by name: registered, imported when asked for, and added by other packages."""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import pytest

from slamdepth.errors import ConfigError
from slamdepth.registry import Registry

Part = Callable[[], str]


def write_package(folder: Path, name: str, **modules: str) -> None:
    """A package whose modules each register a part in ``REGISTRY`` of its root."""
    (folder / name).mkdir()
    root = f"from slamdepth.registry import Registry\nREGISTRY = Registry('part', package='{name}')\n"
    (folder / name / "__init__.py").write_text(root)
    for module, text in modules.items():
        (folder / name / f"{module}.py").write_text(text)


def registers(package: str, part: str) -> str:
    return (
        f"from {package} import REGISTRY\n\n@REGISTRY.register('{part}')\ndef make():\n    return '{part}'\n"
    )


def add_plugins(monkeypatch: pytest.MonkeyPatch, *points: tuple[str, str]) -> None:
    found = EntryPoints(EntryPoint(name, value, "parts") for name, value in points)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: found.select(group=group))


def named(name: str) -> Part:
    return lambda: name


def test_a_registered_part_is_found_by_its_name() -> None:
    registry: Registry[Part] = Registry("part")

    @registry.register("b")
    def make() -> str:
        return "made"

    registry.add("a", named("a"), named)
    assert registry.names() == ["a", "b"]
    assert registry.get("b") is make
    assert make() == "made"


def test_an_unknown_name_lists_the_choices() -> None:
    registry: Registry[Part] = Registry("part")
    registry.register("one")(named("one"))
    with pytest.raises(ConfigError, match=r"^unknown part 'two'; choose from: one$"):
        registry.get("two")
    with pytest.raises(ConfigError, match="choose from: one, file:NAME"):
        registry.get("two", lambda: ["one", "file:NAME"])


def test_messages_and_their_error_may_be_given() -> None:
    registry: Registry[Part] = Registry(
        "part", duplicate="{name} twice", unknown="no {name}, but {choices}", error=ValueError
    )
    registry.add("one", named("one"), named)
    with pytest.raises(ValueError, match=r"^one twice$"):
        registry.add("one", named("one"), test_an_unknown_name_lists_the_choices)
    with pytest.raises(ValueError, match=r"^no two, but one$"):
        registry.get("two")


def test_a_name_is_taken_once_but_a_definition_may_be_executed_again() -> None:
    registry: Registry[Part] = Registry("part")

    def define() -> Part:
        @registry.register("one")
        def make() -> str:
            return "one"

        return make

    define()
    again = define()  # as in a notebook's cell
    assert registry.get("one") is again
    with pytest.raises(ConfigError, match=r"^two parts are called 'one'$"):
        registry.register("one")(again)
    with pytest.raises(ConfigError, match="two parts are called 'one'"):
        registry.register("one")(named("one"))


def test_a_module_is_imported_when_its_name_is_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    write_package(tmp_path, "lazy_parts", first=registers("lazy_parts", "x"))
    from lazy_parts import REGISTRY  # type: ignore[import-not-found]

    listed: Registry[Part] = Registry("part", modules={"x": "lazy_parts.first", "gone": "lazy_parts.first"})
    assert listed.names() == ["x", "gone"]
    assert "lazy_parts.first" not in sys.modules
    with pytest.raises(ConfigError, match="unknown part 'gone'"):  # its module registers no such part
        listed.get("gone")
    assert "lazy_parts.first" in sys.modules
    assert REGISTRY.get("x")() == "x"


def test_every_module_of_a_package_is_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    write_package(tmp_path, "many_parts", b=registers("many_parts", "x"), a=registers("many_parts", "y"))
    from many_parts import REGISTRY  # type: ignore[import-not-found]

    assert REGISTRY.get("y")() == "y"
    assert REGISTRY.names() == ["x", "y"]


def test_other_packages_add_parts(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    add_plugins(
        monkeypatch,
        ("cwd", "os:getcwd"),
        ("own", "os:getcwd"),
        ("file:x", "os:getcwd"),
        ("twice", "os:getcwd"),
        ("twice", "os:getpid"),
        ("missing", "no_such_module:make"),
        ("number", "math:pi"),
    )
    registry: Registry[Part] = Registry(
        "part", modules={"own": "math"}, entry_points="parts", reserved=("file:",)
    )
    registry.register("here")(named("here"))
    assert registry.names() == ["own", "cwd", "here", "missing", "number", "twice"]
    assert "part 'own' of os:getcwd is ignored: the name is taken" in caplog.text
    assert "part 'file:x' of os:getcwd is ignored" in caplog.text
    assert registry.get("cwd")() == str(Path.cwd())
    point = registry.plugin("cwd")
    assert point is not None
    assert point.value == "os:getcwd"
    assert registry.plugin("here") is None
    assert registry.plugin("nowhere") is None
    with pytest.raises(ConfigError, match="two plug-ins add part 'twice': os:getcwd, os:getpid"):
        registry.get("twice")
    with pytest.raises(ConfigError, match="part 'missing': its plug-in no_such_module:make cannot be loaded"):
        registry.get("missing")
    with pytest.raises(ConfigError, match="part 'number': its plug-in math:pi is no factory"):
        registry.get("number")
