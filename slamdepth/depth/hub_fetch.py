# SPDX-License-Identifier: Apache-2.0
"""Download published depth models with huggingface_hub (an optional dependency).

Its settings hold: ``HF_ENDPOINT`` (a mirror), ``HF_TOKEN``, ``HF_HUB_OFFLINE``, ``HF_HOME`` and the usual
proxy variables. What is added here: all files of one commit, a download that goes on where an earlier one
stopped, the sha256 of the weights, and a folder that is complete or not there.
"""

from __future__ import annotations

import hashlib
import logging
import os
import re
import shutil
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from slamdepth.depth import hub_store as hub
from slamdepth.depth.hub_input import FILE as PREPROCESSOR
from slamdepth.depth.weights import Progress
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.io import sha256_of, write_json

_log = logging.getLogger(__name__)


class _AbsentError(Exception):
    """The hub has the model, but not this file."""


@dataclass(frozen=True)
class _Remote:
    """A file on the hub.

    Attributes:
        url: where it is fetched.
        commit: that it belongs to.
        checksum: sha256 of a large file, git's sha1 of a small one.
        size_bytes: None where the hub does not say.
    """

    url: str
    commit: str
    checksum: str
    size_bytes: int | None


def pull(
    reference: hub.Reference, report: Progress | None = None, *, force: bool = False, bar: bool = False
) -> Path:
    """Download a model into the cache folder, unless it is there in the wanted revision.

    Args:
        reference: which model.
        report: called before every file.
        force: download again what is there.
        bar: show the hub's own progress bar of large files on standard error.

    Returns:
        The folder.

    Raises:
        ConfigError: the extra is not installed.
        WeightsError: the hub cannot be reached, does not give the model, or gives another file than the
            pinned one; one line that says what to do. What was downloaded of a large file is kept, and the
            next call goes on from there.
    """
    tell = report or (lambda what, share: None)
    if find_spec("huggingface_hub") is None:
        raise ConfigError(f"downloading from the hub needs huggingface_hub: install it with {hub.EXTRA}")
    folder = reference.folder
    if not force and _is_there(reference):
        tell("already in the cache", 1.0)
        return folder
    _show_bars(bar)
    partial = folder.with_name(folder.name + ".partial")
    if force:
        shutil.rmtree(partial, ignore_errors=True)
    try:
        partial.mkdir(parents=True, exist_ok=True)
        _pull_into(partial, reference, tell)
        if folder.exists():
            shutil.rmtree(folder)
        os.replace(partial, folder)
    except OSError as error:
        raise WeightsError(f"{folder}: cannot be written: {error.strerror or error}") from error
    tell("done", 1.0)
    return folder


def _show_bars(shown: bool) -> None:
    from huggingface_hub.utils import disable_progress_bars, enable_progress_bars

    if "HF_HUB_DISABLE_PROGRESS_BARS" not in os.environ:  # the user's own setting holds
        (enable_progress_bars if shown else disable_progress_bars)()


def _is_there(reference: hub.Reference) -> bool:
    if not (reference.folder / hub.CONFIG).is_file():
        return False
    record = hub.read_record(reference.folder)
    if record is None:  # put there by hand
        return reference.revision is None
    return reference.wanted in (None, record.revision)


def _pull_into(folder: Path, reference: hub.Reference, tell: Progress) -> None:
    repo = reference.repo
    tell(f"asking for {hub.CONFIG} of {repo}", 0.0)
    first = _remote(reference, hub.CONFIG, reference.wanted or "main")
    sums = {hub.CONFIG: _fetch(first, folder / hub.CONFIG, repo)}
    others = [PREPROCESSOR]
    weights = _weights_of(reference, first.commit)
    if weights == hub.INDEX:
        sums[weights] = _fetch(_remote(reference, weights, first.commit), folder / weights, repo)
        others += hub.parts_of(folder / weights)
    else:
        others.append(weights)
    for number, name in enumerate(others):
        try:
            remote = _remote(reference, name, first.commit)
        except _AbsentError as error:
            if name == PREPROCESSOR:  # the type of the model says the same
                continue
            raise WeightsError(f"{repo}: has no {name} at {first.commit[:12]}") from error
        size = "" if remote.size_bytes is None else f", {remote.size_bytes / 1e6:.1f} MB"
        tell(f"downloading {name}{size}", number / len(others))
        sums[name] = _fetch(remote, folder / name, repo)
    pinned = reference.known.sha256 if reference.known and first.commit == reference.known.revision else None
    if pinned is not None and sums.get(weights) != pinned:
        (folder / weights).unlink()
        raise WeightsError(
            f"{weights} of {repo}: sha256 is {sums[weights][:16]}..., not the pinned {pinned[:16]}...; "
            "not used"
        )
    write_json(folder / hub.RECORD, {"repo": repo, "revision": first.commit, "sha256": sums})


def _weights_of(reference: hub.Reference, commit: str) -> str:
    """The name of the weights file, or of the index of several."""
    for name in (hub.WEIGHTS[0], hub.INDEX, *hub.WEIGHTS[1:]):
        try:
            _remote(reference, name, commit)
        except _AbsentError:
            continue
        return name
    raise WeightsError(f"{reference.repo}: has no weights that are read here: {', '.join(hub.WEIGHTS)}")


def _remote(reference: hub.Reference, name: str, revision: str) -> _Remote:
    """Where a file is, and its checksum.

    Raises:
        _AbsentError: the hub has no such file.
        WeightsError: one line that says what is wrong.
    """
    import huggingface_hub as theirs
    from huggingface_hub import constants, errors

    repo, endpoint = reference.repo, constants.ENDPOINT
    by_hand = f"or put {reference.files} into {reference.folder}"
    url = theirs.hf_hub_url(repo, name, revision=revision)
    try:
        found = theirs.get_hf_file_metadata(url)
    except errors.GatedRepoError as error:
        raise WeightsError(
            f"{repo} is gated: accept its terms on {endpoint}/{repo} and set HF_TOKEN, {by_hand}"
        ) from error
    except errors.RepositoryNotFoundError as error:
        raise WeightsError(
            f"{repo}: {endpoint} has no such model, or it is private and HF_TOKEN does not open it"
        ) from error
    except errors.RevisionNotFoundError as error:
        raise WeightsError(f"{repo}: has no revision {revision}") from error
    except errors.EntryNotFoundError as error:
        if name == hub.CONFIG:
            raise WeightsError(f"{repo}: is no model in the hub's layout: it has no {name}") from error
        raise _AbsentError(name) from error
    except errors.OfflineModeIsEnabled as error:
        raise WeightsError(f"{repo}: HF_HUB_OFFLINE forbids downloads; unset it, {by_hand}") from error
    except Exception as error:  # of whichever HTTP library this version uses
        raise WeightsError(f"{endpoint} cannot be reached: {_reason(error)}; try again, {by_hand}") from error
    if found.commit_hash is None or found.etag is None:
        raise WeightsError(
            f"{endpoint} does not answer as a hub does; check HF_ENDPOINT and proxies, {by_hand}"
        )
    return _Remote(url, found.commit_hash, found.etag, found.size)


def _fetch(remote: _Remote, target: Path, repo: str) -> str:
    """Download a file and check it, going on from what is there of it.

    Returns:
        Its sha256.

    Raises:
        WeightsError: the download broke off, or the file is another one than the hub announced.
    """
    import huggingface_hub as theirs
    from huggingface_hub.file_download import http_get

    part = target.with_name(f"{target.name}.{remote.checksum[:16]}.part")
    if target.is_file() and _matches(target, remote.checksum):
        return sha256_of(target)
    cached = theirs.try_to_load_from_cache(repo, target.name, revision=remote.commit)
    if isinstance(cached, str):
        shutil.copyfile(cached, part)
    else:
        _download(http_get, remote, part, theirs.utils.build_hf_headers())
    if not _matches(part, remote.checksum):
        part.unlink()
        raise WeightsError(
            f"{target.name} of {repo}: the downloaded file is not the one that the hub announced (its sha256 "
            "differs); not used"
        )
    os.replace(part, target)
    return sha256_of(target)


def _download(http_get: Any, remote: _Remote, part: Path, headers: dict[str, str]) -> None:
    """Download into ``part``, going on from what is there, as long as each attempt brings some of it."""
    whole = remote.size_bytes
    size = part.stat().st_size if part.is_file() else 0
    if whole is not None and size > whole:
        part.unlink()
        size = 0
    while True:
        before = size
        try:
            with part.open("ab") as file:
                http_get(
                    remote.url, file, resume_size=size, headers=headers, expected_size=whole,
                    displayed_filename=part.name.rsplit(".", 2)[0],
                )  # fmt: skip
            return
        except Exception as error:  # of whichever HTTP library this version uses
            size = part.stat().st_size
            if before < size and (whole is None or size < whole):
                _log.info("%s: broke off after %d bytes, going on: %s", remote.url, size, _reason(error))
                continue
            raise WeightsError(
                f"{remote.url}: the download broke off after {size / 1e6:.1f} MB: {_reason(error)}; the same "
                "command goes on from there"
            ) from error


def _matches(path: Path, checksum: str) -> bool:
    """Whether a file has the checksum that the hub gives: sha256, or git's sha1 for small files."""
    if re.fullmatch(r"[0-9a-f]{64}", checksum):
        return sha256_of(path) == checksum
    if re.fullmatch(r"[0-9a-f]{40}", checksum):
        content = path.read_bytes()
        return hashlib.sha1(b"blob %d\0" % len(content) + content).hexdigest() == checksum
    _log.warning("%s: the hub or mirror states no sha256 for it", path.name)
    return True


def _reason(error: Exception) -> str:
    first = (str(error).strip().splitlines() or [""])[0]
    return f"{type(error).__name__}: {first}" if first else type(error).__name__
