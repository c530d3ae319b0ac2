# SPDX-License-Identifier: Apache-2.0
"""Place recognition: which earlier keyframes show what this one shows.

A bag of binary words weighted by tf-idf (Gálvez-López and Tardós, "Bags of Binary Words
for Fast Place Recognition in Image Sequences", 2012). An answer is a candidate for
geometric verification, never a loop by itself.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import TrackingError
from slamdepth.loops.vocabulary import Vocabulary, load_vocabulary

if TYPE_CHECKING:
    from numpy.typing import NDArray


class PlaceRecogniser:
    """An index of keyframes by the words they show.

    Memory is 4 bytes a word and keyframe (8 KB a keyframe with the shipped vocabulary),
    in an array that doubles when it is full; a query is one product with it.
    """

    def __init__(self, vocabulary: Vocabulary | None = None) -> None:
        self.vocabulary = vocabulary or load_vocabulary()
        self._ids: list[int] = []
        self._row_of: dict[int, int] = {}
        self._vectors = np.empty((64, len(self.vocabulary)), dtype=np.float32)

    def __len__(self) -> int:
        return len(self._ids)

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._row_of

    def describe(self, descriptors: NDArray[np.uint8]) -> NDArray[np.float32]:
        """The place vector ``(W,)`` of an image's descriptors ``(N, 32)`` uint8.

        Counts are square-rooted, so that a repeated texture does not speak for the whole
        image (Jégou et al., "On the burstiness of visual elements", 2009), weighted by
        idf and scaled to unit length; all zero where there is no informative descriptor.
        """
        words = self.vocabulary.quantise(descriptors)
        counts = np.bincount(words, minlength=len(self.vocabulary))
        vector = np.sqrt(counts, dtype=np.float32) * self.vocabulary.idf
        length = float(np.linalg.norm(vector))
        return vector / np.float32(length) if length > 0 else vector

    def add(self, keyframe_id: int, descriptors: NDArray[np.uint8]) -> None:
        """Remember a keyframe by its descriptors ``(N, 32)`` uint8.

        Raises:
            TrackingError: the keyframe is already there.
        """
        self.add_vector(keyframe_id, self.describe(descriptors))

    def add_vector(self, keyframe_id: int, vector: NDArray[np.float32]) -> None:
        """Remember a keyframe by its place vector ``(W,)``, see :meth:`describe`.

        Raises:
            TrackingError: the keyframe is already there.
        """
        if keyframe_id in self._row_of:
            raise TrackingError(f"place recognition: keyframe {keyframe_id} was added before")
        row = len(self._ids)
        if row == len(self._vectors):
            self._vectors = np.concatenate([self._vectors, np.empty_like(self._vectors)])
        self._vectors[row] = vector
        self._ids.append(keyframe_id)
        self._row_of[keyframe_id] = row

    def query(
        self, descriptors: NDArray[np.uint8], *, exclude: Collection[int] = (), top_k: int = 10
    ) -> list[tuple[int, float]]:
        """The keyframes that look most like these descriptors ``(N, 32)`` uint8.

        Args:
            exclude: keyframes not asked for, such as the neighbours in time.
            top_k: at most so many answers.

        Returns:
            ``(keyframe_id, score)``, best first; the score is the cosine of the place
            vectors, above 0 and at most 1. Equal scores are ordered by id.
        """
        return self._ranked(self.describe(descriptors), exclude, top_k)

    def query_keyframe(
        self, keyframe_id: int, *, exclude: Collection[int] = (), top_k: int = 10
    ) -> list[tuple[int, float]]:
        """:meth:`query` with a keyframe that was added; it is never its own answer."""
        return self._ranked(self.vector(keyframe_id), {keyframe_id, *exclude}, top_k)

    def query_vector(self, vector: NDArray[np.float32], *, top_k: int = 10) -> list[tuple[int, float]]:
        """:meth:`query` with a place vector ``(W,)``, as another index of the same vocabulary has it."""
        return self._ranked(vector, (), top_k)

    def best_score(self, vector: NDArray[np.float32]) -> float:
        """Similarity of the keyframe that looks most like a place vector ``(W,)``; 0 where none does."""
        answers = self._ranked(vector, (), 1)
        return answers[0][1] if answers else 0.0

    def absorb(self, other: PlaceRecogniser, first: int) -> None:
        """Take over all keyframes of another index; their ids grow by ``first``."""
        for keyframe_id in other._ids:
            self.add_vector(first + keyframe_id, other.vector(keyframe_id))

    def state(self) -> dict[str, NDArray[Any]]:
        """Ids and place vectors of all keyframes."""
        n = len(self._ids)
        return {"keyframe": np.array(self._ids, dtype=np.int64), "vector": self._vectors[:n].copy()}

    def restore(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Remember what :meth:`state` gave; nothing else is remembered yet."""
        for keyframe_id, vector in zip(state["keyframe"].tolist(), state["vector"], strict=True):
            self.add_vector(keyframe_id, vector)

    def score(self, first_id: int, second_id: int) -> float:
        """Cosine of the place vectors of two keyframes.

        A loop candidate should look more alike than the keyframe's own neighbours do, times
        some factor; absolute scores depend on the scene (Gálvez-López and Tardós, eq. 3).
        """
        return float(np.round(self.vector(first_id) @ self.vector(second_id), 6))

    def vector(self, keyframe_id: int) -> NDArray[np.float32]:
        """The place vector ``(W,)`` of a keyframe that was added.

        Raises:
            TrackingError: it was not.
        """
        if keyframe_id not in self._row_of:
            raise TrackingError(f"place recognition: keyframe {keyframe_id} was never added")
        return np.asarray(self._vectors[self._row_of[keyframe_id]])

    def _ranked(
        self, vector: NDArray[np.float32], exclude: Collection[int], top_k: int
    ) -> list[tuple[int, float]]:
        # Rounded, so that the last bit of a float32 sum does not decide a tie.
        scores = np.round(self._vectors[: len(self._ids)] @ vector, 6)
        rows = [self._row_of[i] for i in exclude if i in self._row_of]
        scores[rows] = 0.0
        best = np.lexsort((np.asarray(self._ids), -scores))[:top_k]
        return [(self._ids[row], float(scores[row])) for row in best if scores[row] > 0]
