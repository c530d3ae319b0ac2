# SPDX-License-Identifier: Apache-2.0
"""Damaged input for every reader and parser: ``make fuzz``, or ``python tests/fuzz.py --cases 500 --seed 1``.

A case takes a good recording or file, damages it at random, and reads all of it. It must end in a
``SlamdepthError`` of one line or in a sound result. Anything else (another error, more than one line, a
result that is not finite, a crash, more than half a minute) is a finding, named by what repeats it:
``python tests/fuzz.py --only euroc --case 17``. A case depends on its number and the seed only.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fuzz_targets import FindingError, Target, targets

from slamdepth.errors import SlamdepthError

LIMIT_S = 30
_MEMORY_BYTES = 12 * 1024**3
_BATCH = 25
_TEXTS = (".txt", ".csv", ".yaml", ".json", ".freiburg", ".cfg", ".obj", ".off", "")
# fmt: off
_ABSURD = (
    "nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e-320", "1e999", "99999999999999999999999", "1_000",
    "", "x", "0x10", "../../etc/passwd", "/etc/passwd", "-0.0", "true", "null", "[]", "{}", "\0", "é",
    "2147483648", "18446744073709551616", "\ufeff", "1e-300", "1.7976931348623157e308", "'", '"', "&a *a",
    "!!python/name:os",
)
# fmt: on
_NUMBER = re.compile(r"[-+]?\d[\d.]*(?:[eE][-+]?\d+)?")


def run_case(target: Target, number: int, seed: int, good: tuple[Path, Path], folder: Path) -> None:
    """Run one case.

    Args:
        good: a folder, and what ``target.make`` returned for it; not changed.
        folder: absent yet; takes the damaged copy.

    Raises:
        FindingError: it ended in what it must not end in.
    """
    rng = random.Random(f"{target.name} {number} {seed}")
    shutil.copytree(good[0], folder)
    path = folder / good[1].relative_to(good[0])
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        _damage(folder, rng)
    try:
        with _time_limit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            target.read(path)
    except SlamdepthError as error:
        message = str(error)
        if not message.strip() or "\n" in message or "\r" in message:
            raise FindingError(f"a message of several lines or none: {message[:300]!r}") from error
    except FindingError:
        raise
    except BaseException as error:
        place = traceback.extract_tb(error.__traceback__)[-1]
        raise FindingError(
            f"{type(error).__name__}: {error} ({place.filename}:{place.lineno})"[:400]
        ) from error


@contextmanager
def _time_limit() -> Iterator[None]:
    def late(*_: object) -> None:
        raise TimeoutError(f"more than {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def _damage(folder: Path, rng: random.Random) -> None:
    """Damage one file of a folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    if not files:
        return
    # Lists and headers are what parsers read; images are many.
    lists = [path for path in files if path.suffix not in (".png", ".jpg")]
    path = rng.choice(lists if lists and rng.random() < 0.85 else files)
    data = path.read_bytes()
    is_text = path.suffix in _TEXTS and b"\0" not in data
    ways: list[Callable[[bytes, random.Random], bytes]] = [_cut, _flip, _overwrite, _insert, _random, _grow]
    if is_text:
        ways = [*ways, *[_absurd] * 6, _drop_line, _repeat_line, _swap_lines, _other_ends]
    chosen = rng.random()
    if chosen < 0.03:
        path.unlink()
    elif chosen < 0.05:
        path.unlink()
        path.mkdir()
    elif chosen < 0.06:
        path.unlink()
        path.symlink_to(path.name)
    else:
        path.write_bytes(rng.choice(ways)(data, rng))


def _cut(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data) + 1)]


def _flip(data: bytes, rng: random.Random) -> bytes:
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 2, 8, 64))):
        if out:
            at = rng.randrange(len(out)) if rng.random() < 0.5 else rng.randrange(min(len(out), 256))
            out[at] ^= 1 << rng.randrange(8)
    return bytes(out)


def _overwrite(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1) if rng.random() < 0.5 else rng.randrange(min(len(data), 256) + 1)
    value = rng.choice((b"\xff" * 8, b"\0" * 8, b"\x7f" * 4, b"\xff\xff\xff\x7f", rng.randbytes(8)))
    return data[:at] + value + data[at + len(value) :]


def _insert(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) + 1)
    return data[:at] + rng.randbytes(rng.choice((1, 3, 100))) + data[at:]


def _random(data: bytes, rng: random.Random) -> bytes:
    return rng.randbytes(rng.choice((0, 1, 10, 1000, min(len(data), 100_000))))


def _grow(data: bytes, rng: random.Random) -> bytes:
    return data * rng.choice((2, 3))


def _absurd(data: bytes, rng: random.Random) -> bytes:
    text = data.decode("utf-8", errors="replace")
    found = list(_NUMBER.finditer(text)) if rng.random() < 0.8 else list(re.finditer(r"[^\s,]+", text))
    if not found:
        return data
    for match in sorted(
        rng.sample(found, min(len(found), rng.choice((1, 1, 2, 20)))), key=lambda m: -m.start()
    ):
        text = text[: match.start()] + rng.choice(_ABSURD) + text[match.end() :]
    return text.encode("utf-8", errors="surrogatepass")


def _lines(data: bytes, change: Callable[[list[bytes]], None]) -> bytes:
    lines = data.split(b"\n")
    change(lines)
    return b"\n".join(lines)


def _drop_line(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, lambda lines: lines.__delitem__(rng.randrange(len(lines))))


def _repeat_line(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, lambda lines: lines.insert(rng.randrange(len(lines)), rng.choice(lines)))


def _swap_lines(data: bytes, rng: random.Random) -> bytes:
    return _lines(data, rng.shuffle)


def _other_ends(data: bytes, rng: random.Random) -> bytes:
    return data.replace(b"\n", rng.choice((b"\r\n", b"\r", b" ", b"\n\n", b",\n")))


def _work(name: str, numbers: list[int], seed: int, folder: Path, told: Any, at: Any) -> None:
    """Cases of one target in a process of its own, so that a crash costs the others nothing."""
    # libpng and OpenCV tell of each damaged image on standard error.
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
    (target,) = (one for one in targets() if one.name == name)
    with tempfile.TemporaryDirectory(dir=folder) as place:
        good = Path(place) / "good"
        good.mkdir()
        path = target.make(good)
        for number in numbers:
            at.value = number
            damaged = Path(place) / f"{number}"
            try:
                run_case(target, number, seed, (good, path), damaged)
            except FindingError as finding:
                told.put((name, number, str(finding)))
            shutil.rmtree(damaged, ignore_errors=True)


def main(arguments: list[str] | None = None) -> int:
    """Run the job; returns 1 where there is a finding."""
    parser = argparse.ArgumentParser(description="Read damaged input.")
    parser.add_argument("--cases", type=int, default=200, help="cases of each target (default: 200)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="one target")
    parser.add_argument("--case", type=int, help="one case")
    asked = parser.parse_args(arguments)
    names = [target.name for target in targets() if asked.only in (None, target.name)]
    if not names:
        print(
            f"no target {asked.only}; there are {', '.join(one.name for one in targets())}", file=sys.stderr
        )
        return 2
    numbers = list(range(asked.cases)) if asked.case is None else [asked.case]
    context = multiprocessing.get_context("fork")
    findings = 0
    with tempfile.TemporaryDirectory(prefix="slamdepth-fuzz-") as folder:
        for name in names:
            found: list[tuple[str, int, str]] = []
            left = list(numbers)
            while left:
                batch, left = left[:_BATCH], left[_BATCH:]
                told, at = context.SimpleQueue(), context.Value("i", batch[0])
                process = context.Process(
                    target=_work, args=(name, batch, asked.seed, Path(folder), told, at)
                )
                process.start()
                process.join((LIMIT_S + 5) * len(batch))
                if process.exitcode != 0:
                    process.kill()
                    found.append((name, at.value, f"the process ended with {process.exitcode}"))
                    left = [number for number in batch if number > at.value] + left
                while not told.empty():
                    found.append(told.get())
            findings += len(found)
            print(f"{name:18} {len(numbers):6} cases {len(found):4} findings", flush=True)
            for target, number, what in found:
                print(f"    --only {target} --case {number} --seed {asked.seed}: {what}", flush=True)
    print(f"{len(names) * len(numbers)} cases, {findings} findings")
    return 1 if findings else 0


if __name__ == "__main__":
    sys.exit(main())
