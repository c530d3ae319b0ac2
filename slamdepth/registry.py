# SPDX-License-Identifier: Apache-2.0
"""Swappable parts by name: registered by a decorator, imported when they are first asked for.

A :class:`Registry` finds a part in up to three places: modules of this package that are listed by
name, every module of a package, and entry points of other installed packages. The scheme is that of
timm's ``models/_registry.py``, with plug-ins by ``importlib.metadata``.
"""

from __future__ import annotations

import importlib
import logging
import pkgutil
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from slamdepth.errors import ConfigError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

_log = logging.getLogger(__name__)

T = TypeVar("T")


class Registry(Generic[T]):
    """Parts of one kind by name.

    Args:
        kind: what a part is called in messages, such as ``"depth model"``.
        modules: names with the module that registers each; imported when the name is asked for.
        package: a package; all of its modules are imported when names are asked for.
        entry_points: group of entry points by which other packages add parts; loaded when asked for.
        reserved: prefixes of names that are not for plug-ins to take.
        duplicate: message for a name that is registered twice; ``{name}`` stands for it.
        unknown: message for a name that does not exist; ``{name}`` and ``{choices}`` are filled in.
        error: what is raised with either message.

    Attributes:
        parts: what is registered so far.
    """

    def __init__(
        self,
        kind: str,
        *,
        modules: Mapping[str, str] | None = None,
        package: str | None = None,
        entry_points: str | None = None,
        reserved: tuple[str, ...] = (),
        duplicate: str = "",
        unknown: str = "",
        error: type[Exception] = ConfigError,
    ) -> None:
        self.kind = kind
        self.parts: dict[str, T] = {}
        self._definitions: dict[str, Any] = {}
        self._modules = dict(modules or {})
        self._package = package
        self._entry_points = entry_points
        self._reserved = reserved
        self._duplicate = duplicate or f"two {kind}s are called '{{name}}'"
        self._unknown = unknown or f"unknown {kind} '{{name}}'; choose from: {{choices}}"
        self._error = error

    def register(self, name: str) -> Callable[[T], T]:
        """Decorator: make a class or function the part called ``name``; see :meth:`add`."""

        def register_as(part: T) -> T:
            self.add(name, part, part)
            return part

        return register_as

    def add(self, name: str, part: T, definition: Any) -> None:
        """Make ``part`` known as ``name``.

        Args:
            definition: the class or function that ``part`` is or was made from. A definition that is
                executed again, in a reloaded module or a notebook's cell, replaces the earlier one.

        Raises:
            Exception: of the registry's ``error`` type, the name is taken by another definition.
        """
        if name in self.parts and not _is_executed_again(self._definitions.get(name), definition):
            raise self._error(self._duplicate.format(name=name))
        self.parts[name], self._definitions[name] = part, definition

    def names(self) -> list[str]:
        """Every name that exists: the listed ones in their order, then all others sorted."""
        self._import_package()
        return [*self._modules, *sorted({*self.parts, *self._plugins()} - set(self._modules))]

    def get(self, name: str, choices: Callable[[], list[str]] | None = None) -> T:
        """The part called ``name``.

        Args:
            choices: gives the names for the message, where they are not those of :meth:`names` alone.

        Raises:
            Exception: of the registry's ``error`` type, there is no such part.
            ConfigError: two plug-ins have the name, or its plug-in cannot be loaded or called.
        """
        if name not in self.parts:
            self._import_package()
        if name not in self.parts and name in self._modules:
            importlib.import_module(self._modules[name])
        if name in self.parts:
            return self.parts[name]
        point = self.plugin(name)
        if point is None:
            listed = ", ".join(self.names() if choices is None else choices())
            raise self._error(self._unknown.format(name=name, choices=listed))
        return self._load(name, point)

    def plugin(self, name: str) -> EntryPoint | None:
        """The entry point that adds ``name``; None where no other package does.

        Raises:
            ConfigError: two plug-ins have the name.
        """
        points = [] if name in self.parts else self._plugins().get(name, [])
        if len(points) > 1:
            raise ConfigError(
                f"two plug-ins add {self.kind} '{name}': {', '.join(point.value for point in points)}"
            )
        return points[0] if points else None

    def _import_package(self) -> None:
        if self._package is not None:
            package = importlib.import_module(self._package)
            for module in pkgutil.iter_modules(package.__path__):
                importlib.import_module(f"{package.__name__}.{module.name}")

    def _load(self, name: str, point: EntryPoint) -> T:
        try:
            part: Any = point.load()
        except Exception as error:  # whatever a foreign module raises when imported
            raise ConfigError(
                f"{self.kind} '{name}': its plug-in {point.value} cannot be loaded: {error}"
            ) from error
        if not callable(part):
            raise ConfigError(f"{self.kind} '{name}': its plug-in {point.value} is no factory")
        loaded: T = part
        return loaded

    def _plugins(self) -> dict[str, list[EntryPoint]]:
        """Entry points of other packages by name, without those whose name is taken here."""
        if self._entry_points is None:
            return {}
        from importlib.metadata import entry_points

        found: dict[str, list[EntryPoint]] = {}
        for point in entry_points(group=self._entry_points):
            if point.name in self._modules or point.name.startswith(self._reserved):
                _log.warning(
                    "%s '%s' of %s is ignored: the name is taken", self.kind, point.name, point.value
                )
                continue
            found.setdefault(point.name, []).append(point)
        return found


def _is_executed_again(before: Any, definition: Any) -> bool:
    def place(of: Any) -> tuple[Any, Any]:
        return getattr(of, "__module__", None), getattr(of, "__qualname__", None)

    return before is not definition and place(before) == place(definition) != (None, None)
