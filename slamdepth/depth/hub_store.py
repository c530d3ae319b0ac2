# SPDX-License-Identifier: Apache-2.0
"""Where published depth models are kept: references to them, their folders, and what was pulled.

A model is a folder in the hub's layout: ``config.json``, ``preprocessor_config.json`` and the weights. It is
looked for in ``hub/ORG/NAME`` of the cache folder, where ``slamdepth weights pull`` puts it, then in the
hub's own cache. Nothing here imports transformers.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from slamdepth.depth import weights as store
from slamdepth.depth.hub_models import AUTO, BY_NAME, BY_REPO, HubModel
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.io import sha256_of

PREFIX = "hf:"
CONFIG = "config.json"
WEIGHTS = ("model.safetensors", "pytorch_model.bin")
"""Weights files, the preferred one first."""

INDEX = "model.safetensors.index.json"
RECORD = "slamdepth_pulled.json"
UNKNOWN = "not known here: see its page on the hub"
EXTRA = "pip install 'slamdepth[hub]'"

_REPO = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass(frozen=True)
class Reference:
    """A model on the hub.

    Attributes:
        name: as it was asked for.
        repo: ``ORG/NAME``.
        revision: branch, tag or commit that was asked for; None takes the pinned one, else the newest.
        known: its entry in the table, or None.
    """

    name: str
    repo: str
    revision: str | None = None
    known: HubModel | None = None

    @property
    def wanted(self) -> str | None:
        """The revision that is fetched; None where any will do."""
        return self.revision or (self.known.revision if self.known else None)

    @property
    def folder(self) -> Path:
        """Its place in the cache folder; it need not be there."""
        return store.cache_dir() / "hub" / self.repo

    @property
    def files(self) -> str:
        """The files that make up a model, for messages."""
        return f"{CONFIG}, preprocessor_config.json and {WEIGHTS[0]} of {self.repo}"


@dataclass(frozen=True)
class PulledRecord:
    """What was pulled into a folder.

    Attributes:
        repo: ``ORG/NAME``.
        revision: the commit.
        sha256: of each file, by name.
    """

    repo: str
    revision: str
    sha256: dict[str, str]


def reference_of(name: str) -> Reference:
    """The model that a short name, or ``hf:ORG/NAME`` with or without ``@REVISION``, stands for.

    Raises:
        ConfigError: it is neither.
    """
    if (known := BY_NAME.get(name)) is not None:
        return Reference(name, known.repo, None, known)
    repo, _, revision = name.removeprefix(PREFIX).partition("@")
    if not name.startswith(PREFIX) or not _REPO.fullmatch(repo) or ".." in repo or repo.startswith("."):
        raise ConfigError(
            f"'{name}' is no model of the hub: write hf:ORG/NAME, hf:ORG/NAME@REVISION, hf:./FOLDER, or one "
            f"of {', '.join(BY_NAME)}"
        )
    known = BY_REPO.get(repo.lower())
    return Reference(name, known.repo if known else repo, revision or None, known)


def local_folder(name: str) -> Path | None:
    """The folder that ``hf:FOLDER``, or a path alone, names; None where it names none.

    A path alone must have a slash and hold a ``config.json``, so that no folder is taken for a model's name.
    """
    text = name.removeprefix(PREFIX)
    path = Path(text).expanduser()
    if name.startswith(PREFIX):
        return path if path.is_dir() or text.startswith(("./", "../", "/", "~")) else None
    return path if "/" in text and (path / CONFIG).is_file() else None


def is_hub_name(name: str) -> bool:
    """Whether ``name`` is a local folder or is written as a model of the hub; it need not be there."""
    return name.startswith(PREFIX) or local_folder(name) is not None


def find_folder(reference: Reference) -> Path | None:
    """The folder of a model that is on this machine, or None.

    Raises:
        WeightsError: it is there in another revision than the one that was asked for.
    """
    folder = reference.folder
    if (folder / CONFIG).is_file():
        record = read_record(folder)
        asked = reference.revision
        if asked and record and not record.revision.startswith(asked) and _is_commit(asked):
            raise WeightsError(
                f"{folder}: is revision {record.revision[:12]}, not {asked}; get it with "
                f"'{store.PULL_COMMAND} {reference.name}'"
            )
        return folder
    return _in_the_hubs_cache(reference)


def missing(reference: Reference, official: str = "") -> WeightsError:
    """The error for a model that is not on this machine: one line that says what to put where."""
    return WeightsError(
        f"depth model '{reference.name}' has no weights: get them with '{store.PULL_COMMAND} "
        f"{reference.name}' (once, online), or put {reference.files} into {reference.folder}{official}"
    )


def weights_files(folder: Path) -> list[Path]:
    """The weights of the model in ``folder``: one file, or the parts that its index lists.

    Raises:
        WeightsError: there are none.
    """
    for name in WEIGHTS:
        if (folder / name).is_file():
            return [folder / name]
    if (folder / INDEX).is_file():
        return [folder / name for name in parts_of(folder / INDEX)]
    raise WeightsError(f"{folder}: has no weights: none of {', '.join(WEIGHTS)}, {INDEX}")


def parts_of(index: Path) -> list[str]:
    """The names of the files that the index of a divided model lists.

    Raises:
        WeightsError: it is no index.
    """
    try:
        names = sorted(
            {str(name) for name in json.loads(index.read_text(encoding="utf-8"))["weight_map"].values()}
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise WeightsError(f"{index}: not a readable index of weights files: {error}") from error
    if not names or any("/" in name or not name.endswith(".safetensors") for name in names):
        raise WeightsError(f"{index}: not an index of weights files")
    return names


def checked_sha256(file: Path) -> str:
    """The sha256 of a model's file, checked against the one recorded when it was pulled, if it was.

    Raises:
        WeightsError: the file was changed since.
    """
    digest = sha256_of(file)
    record = read_record(file.parent)
    if record is not None and record.sha256.get(file.name, digest) != digest:
        raise WeightsError(
            f"{file}: damaged (its sha256 is not the recorded one); get it again with "
            f"'{store.PULL_COMMAND} {PREFIX}{record.repo} --force'"
        )
    return digest


def read_record(folder: Path) -> PulledRecord | None:
    """What was pulled into ``folder``; None where it was put there by hand.

    Raises:
        WeightsError: the record is damaged.
    """
    path = folder / RECORD
    if not path.is_file():
        return None
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        return PulledRecord(str(values["repo"]), str(values["revision"]), dict(values["sha256"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise WeightsError(f"{path}: not a readable record; delete {folder} and pull it again") from error


def hub_entries() -> list[store.WeightsEntry]:
    """The models with short names for ``slamdepth weights list``, and others that were pulled."""
    root = store.cache_dir() / "hub"
    pulled = [f"{PREFIX}{path.parent.relative_to(root).as_posix()}" for path in root.glob(f"*/*/{CONFIG}")]
    others = [ref for ref in map(reference_of, sorted(pulled)) if ref.known is None or ref.known.name is None]
    return [_entry(reference) for reference in (*map(reference_of, BY_NAME), *others)]


def has_extra() -> bool:
    """Whether transformers is installed; it is not imported."""
    return find_spec("transformers") is not None


def auto_name() -> tuple[str, str]:
    """The model that ``--depth auto`` takes, and why: the best metric one in the cache folder, else the
    embedded one.

    Only models that the user pulled or put into the cache folder count, not what other programs left in the
    hub's cache.
    """
    if not has_extra():
        return "dinov2", f"the embedded model; without the extra no other can run ({EXTRA})"
    for name in AUTO:
        reference = reference_of(name)
        if (reference.folder / CONFIG).is_file() or official_file(reference) is not None:
            return name, "the best metric model in the cache folder"
    return "dinov2", f"the embedded model; no other metric one of rooms is in {store.cache_dir()}"


def official_file(reference: Reference) -> Path | None:
    """The file that a model's authors publish in their own layout, where it is in the cache folder."""
    stem = reference.known.official if reference.known else None
    if stem is None:
        return None
    files = (store.cache_dir() / f"{stem}{suffix}" for suffix in (".pth", ".safetensors"))
    return next((file for file in files if file.is_file()), None)


def _entry(reference: Reference) -> store.WeightsEntry:
    known, folder = reference.known, reference.folder
    about = (known.licence, known.training.data) if known else (UNKNOWN, UNKNOWN)
    files = weights_files(folder) if (folder / CONFIG).is_file() else []
    if not files and (official := official_file(reference)) is not None:
        files = [official]
    if not files:
        return store.WeightsEntry(reference.name, "absent", None, None, None, *about)
    size = sum(file.stat().st_size for file in files)
    digest = sha256_of(files[0]) if len(files) == 1 else None
    return store.WeightsEntry(reference.name, "cached", files[0], size, digest, *about)


def _in_the_hubs_cache(reference: Reference) -> Path | None:
    if find_spec("huggingface_hub") is None:
        return None
    from huggingface_hub import try_to_load_from_cache

    found = try_to_load_from_cache(reference.repo, CONFIG, revision=reference.wanted or "main")
    if not isinstance(found, str):
        return None
    folder = Path(found).parent
    has_weights = any((folder / name).is_file() for name in (*WEIGHTS, INDEX))
    return folder if has_weights else None


def _is_commit(revision: str) -> bool:
    return re.fullmatch(r"[0-9a-f]{7,40}", revision) is not None
