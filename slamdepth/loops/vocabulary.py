# SPDX-License-Identifier: Apache-2.0
"""A small vocabulary of binary words: which of 2,000 words is an ORB descriptor nearest to."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import WeightsError
from slamdepth.frontend.metric import hamming_nearest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Descriptors = NDArray[np.uint8]

DESCRIPTOR_BYTES = 32
_SHIPPED = "orb_vocabulary.npz"


@dataclass(frozen=True)
class Vocabulary:
    """Binary words and the weight of each.

    Attributes:
        words: ``(W, 32)`` uint8.
        idf: ``(W,)`` float32 inverse document frequency, natural logarithm.
        description: data, counts and command it was trained with.
    """

    words: Descriptors
    idf: NDArray[np.float32]
    description: str = ""

    def __post_init__(self) -> None:
        count = len(self.words)
        if self.words.dtype != np.uint8 or self.words.shape != (count, DESCRIPTOR_BYTES) or count == 0:
            raise WeightsError(
                f"vocabulary: words must be (W, {DESCRIPTOR_BYTES}) uint8, "
                f"got {self.words.shape} {self.words.dtype}"
            )
        if self.idf.shape != (count,) or not np.all(np.isfinite(self.idf)) or np.any(self.idf < 0):
            raise WeightsError(f"vocabulary: idf must be ({count},) finite and not negative")

    def __len__(self) -> int:
        return len(self.words)

    def quantise(self, descriptors: Descriptors) -> NDArray[np.intp]:
        """The nearest word of each descriptor in Hamming distance, searched exhaustively.

        A search down the tree the words were trained with is seven times faster but finds
        the nearest word less often, and recognises places worse for it.

        Args:
            descriptors: ``(N, 32)`` uint8.

        Returns:
            ``(N,)`` indices of words; ties go to the lowest index.

        Raises:
            ValueError: the descriptors have another shape or type.
        """
        return hamming_nearest(check_descriptors(descriptors), self.words)

    def save(self, path: str | Path) -> None:
        """Write the ``.npz`` that :func:`load_vocabulary` reads; the same bytes every time."""
        np.savez_compressed(
            path,
            words=self.words,
            idf=self.idf,
            description=np.array(self.description),
        )


def load_vocabulary(path: str | Path | None = None) -> Vocabulary:
    """Read a vocabulary, by default the one shipped with the package.

    Raises:
        WeightsError: the file is missing, damaged or of another layout.
    """
    origin = str(path) if path is not None else f"slamdepth/assets/{_SHIPPED}"
    source = Path(path) if path is not None else resources.files("slamdepth.assets") / _SHIPPED
    try:
        with source.open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return Vocabulary(
                words=arrays["words"],
                idf=arrays["idf"],
                description=str(arrays["description"]),
            )
    except WeightsError as error:
        raise WeightsError(f"{origin}: {error}") from error
    except Exception as error:  # numpy and zipfile raise a zoo of types for a damaged file
        raise WeightsError(
            f"{origin}: cannot read the vocabulary ({error}); reinstall slamdepth or train one with "
            "'python data_scripts/train_vocabulary.py'"
        ) from error


def check_descriptors(descriptors: Descriptors) -> Descriptors:
    """``descriptors`` as contiguous ``(N, 32)`` uint8.

    Raises:
        ValueError: another shape or type.
    """
    descriptors = np.asarray(descriptors)
    if descriptors.dtype != np.uint8 or descriptors.ndim != 2 or descriptors.shape[1] != DESCRIPTOR_BYTES:
        raise ValueError(
            f"descriptors must be (N, {DESCRIPTOR_BYTES}) uint8, got {descriptors.shape} {descriptors.dtype}"
        )
    return np.ascontiguousarray(descriptors)
