# SPDX-License-Identifier: Apache-2.0
"""Blocks of numbered training pairs that are judged on and left out of training.

Neighbouring numbers of such a folder show one place, so the numbers next to a block are left out of training
too, and are not judged on.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from slamdepth.errors import ConfigError, DatasetError
from slamdepth.training.data import data_folder, split_numbers
from slamdepth.training.readers.pairs import PairPlace, PairReader

Block = tuple[int, int]


def open_pairs(named: Path) -> PairPlace:
    """The pairs in a folder ``NAME``, or those of some numbers, ``NAME[FIRST-LAST]``.

    Args:
        named: absolute, relative to the current folder, or below ``$SLAMDEPTH_DATA``.

    Raises:
        DatasetError: there are no such pairs.
    """
    folder, numbers = split_numbers(named)
    place = PairReader().open(data_folder(str(folder)).resolve())
    return place if numbers is None else place.between(*numbers)


def blocks_by_folder(named: Iterable[Path]) -> dict[Path, list[Block]]:
    """The blocks ``NAME[FIRST-LAST]`` of each folder.

    Raises:
        ConfigError: one has no numbers.
        DatasetError: a folder is missing.
    """
    blocks: dict[Path, list[Block]] = {}
    for part in named:
        folder, numbers = split_numbers(part)
        if numbers is None:
            raise ConfigError(f"--held-out {part}: a block is NAME[FIRST-LAST]")
        blocks.setdefault(data_folder(str(folder)).resolve(), []).append(numbers)
    return blocks


def held_out(folder: Path, blocks: Sequence[Block]) -> PairPlace:
    """The pairs of all ``blocks`` of a folder as one place.

    Raises:
        DatasetError: there are none in one of the blocks.
    """
    place = PairReader().open(folder)
    for block in blocks:
        place.between(*block)
    return place.part(f"{place.name}-held-out", _numbered(place, blocks))


def without(place: PairPlace, blocks: Sequence[Block], margin: int) -> PairPlace:
    """``place`` without the pairs of ``blocks`` and of ``margin`` numbers on each side of them.

    Raises:
        DatasetError: nothing is left.
    """
    left_out = set(_numbered(place, [(first - margin, last + margin) for first, last in blocks]))
    kept = [k for k in range(len(place)) if k not in left_out]
    if not kept:
        raise DatasetError(f"{place.name}: every pair is held out or next to one that is")
    return place.part(place.name, kept)


def every(place: PairPlace, step: int) -> PairPlace:
    """Every ``step``-th pair of ``place``."""
    return place.part(place.name, range(0, len(place), step))


def _numbered(place: PairPlace, blocks: Sequence[Block]) -> list[int]:
    """Indices of the pairs whose number is in one of ``blocks``, in order."""
    return sorted({k for first, last in blocks for k in place.numbered(first, last)})
