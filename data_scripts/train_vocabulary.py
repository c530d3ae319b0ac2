#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Train the ORB vocabulary: hierarchical k-majority clustering of binary descriptors.

    python data_scripts/train_vocabulary.py --data DIR --output FILE

DIR holds one folder of .jpg images per place. The same arguments give the same bytes.

k-majority (Grana et al., "A fast approach for integrating ORB descriptors in the bag of words model",
2013) is k-means in Hamming space: the centre of a cluster is the majority vote of each bit. There are two
levels, as in Nistér and Stewénius, "Scalable recognition with a vocabulary tree" (2006), and each leaf is
weighted by ``log(images / images with the word)``.
"""

from __future__ import annotations

import argparse
import logging
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from slamdepth.errors import DatasetError, OutputError, SlamdepthError
from slamdepth.frontend.metric import hamming, hamming_nearest
from slamdepth.loops.vocabulary import DESCRIPTOR_BYTES, Vocabulary, check_descriptors

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Descriptors = NDArray[np.uint8]

logger = logging.getLogger(__name__)


def k_majority(
    descriptors: Descriptors, count: int, rng: np.random.Generator, iterations: int = 25
) -> tuple[Descriptors, NDArray[np.intp]]:
    """Cluster ``(N, 32)`` uint8 descriptors into ``count`` binary centres.

    Args:
        rng: draws the initial centres.
        iterations: upper bound; stops earlier once no descriptor changes its cluster.

    Returns:
        Centres ``(count, 32)`` uint8 and the cluster ``(N,)`` of each descriptor.

    Raises:
        ValueError: there are fewer distinct descriptors than clusters.
    """
    descriptors = check_descriptors(descriptors)
    distinct = np.unique(descriptors, axis=0)
    if len(distinct) < count:
        raise ValueError(f"{count} clusters need as many distinct descriptors, got {len(distinct)}")
    centres = distinct[_spread_seeds(distinct, count, rng)]
    cluster = hamming_nearest(descriptors, centres)
    for _ in range(iterations):
        centres = _majority(descriptors, cluster, centres)
        moved = hamming_nearest(descriptors, centres)
        if np.array_equal(moved, cluster):
            break
        cluster = moved
    return centres, cluster


def train_vocabulary(
    images: Sequence[Descriptors],
    branches: int,
    leaves: int,
    seed: int,
    description: str = "",
) -> Vocabulary:
    """A vocabulary of ``branches * leaves`` words from the descriptors of each image.

    Args:
        images: one ``(N_i, 32)`` uint8 array per image.
        branches, leaves: number of clusters at the first level, and within each of them.
        seed: of the initial centres.
        description: stored with the vocabulary.

    Raises:
        ValueError: there are too few distinct descriptors for that many words.
    """
    descriptors = np.concatenate([check_descriptors(image) for image in images])
    rng = np.random.default_rng(seed)
    _, branch = k_majority(descriptors, branches, rng)
    words = np.empty((branches * leaves, DESCRIPTOR_BYTES), dtype=np.uint8)
    for b in range(branches):
        words[b * leaves : (b + 1) * leaves], _ = k_majority(descriptors[branch == b], leaves, rng)
        logger.info("branch %d of %d: %d descriptors", b + 1, branches, np.sum(branch == b))
    unweighted = Vocabulary(words, np.ones(len(words), dtype=np.float32))
    seen_in = np.zeros(len(words))
    for image in images:
        seen_in[np.unique(unweighted.quantise(image))] += 1
    idf = np.log(len(images) / np.maximum(seen_in, 1.0)).astype(np.float32)
    return Vocabulary(words, idf, description)


def read_descriptors(folder: Path, exclude: Sequence[str], features: int) -> list[Descriptors]:
    """ORB descriptors of every ``folder/<place>/*.jpg`` except in the places ``exclude``.

    Raises:
        DatasetError: the folder is missing, or has no image that decodes.
    """
    import cv2

    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such folder; expected one folder of .jpg images per place")
    orb = cv2.ORB.create(nfeatures=features, fastThreshold=7)
    found: list[Descriptors] = []
    for path in sorted(folder.glob("*/*.jpg")):
        if path.parent.name in exclude:
            continue
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            logger.warning("%s: does not decode, left out", path)
            continue
        _, descriptors = orb.detectAndCompute(image, None)
        if descriptors is not None:
            found.append(np.asarray(descriptors, dtype=np.uint8))
    if not found:
        raise DatasetError(f"{folder}: no image found as <place>/*.jpg")
    return found


def _spread_seeds(distinct: Descriptors, count: int, rng: np.random.Generator) -> NDArray[np.intp]:
    """k-means++ seeding in Hamming space, on a sample to bound its cost."""
    sample = np.sort(rng.choice(len(distinct), size=min(len(distinct), 20000), replace=False))
    candidates = distinct[sample]
    chosen = [int(rng.integers(len(sample)))]
    squared = np.full(len(sample), np.inf)
    while len(chosen) < count:
        to_last = hamming(candidates, candidates[chosen[-1]]).astype(np.float64)
        squared = np.minimum(squared, to_last**2)
        chosen.append(int(rng.choice(len(sample), p=squared / squared.sum())))
    return sample[chosen]


def _majority(descriptors: Descriptors, cluster: NDArray[np.intp], previous: Descriptors) -> Descriptors:
    """The bitwise majority of each cluster; an empty cluster keeps its centre, a tie is 1."""
    centres: Descriptors = previous.copy()
    order = np.argsort(cluster, kind="stable")
    bounds = np.searchsorted(cluster[order], np.arange(len(previous) + 1))
    for k in np.flatnonzero(np.diff(bounds)):
        members = order[bounds[k] : bounds[k + 1]]
        votes = np.zeros(DESCRIPTOR_BYTES * 8, dtype=np.int64)
        for start in range(0, len(members), 65536):
            bits = np.unpackbits(descriptors[members[start : start + 65536]], axis=1)
            votes += bits.sum(axis=0, dtype=np.int64)
        centres[k] = np.packbits(2 * votes >= len(members))
    return centres


def main(argv: list[str] | None = None) -> int:
    """Run the script; returns its exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", type=Path, required=True, help="folder with one folder of .jpg per place")
    parser.add_argument("--output", type=Path, required=True, help=".npz file to write")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--branches", type=int, default=40, help="clusters of the first level")
    parser.add_argument("--leaves", type=int, default=50, help="words per branch")
    parser.add_argument("--features", type=int, default=1000, help="ORB features per image")
    parser.add_argument("--exclude", nargs="*", default=["kitchen_kinect"], help="places to leave out")
    try:
        train_from_images(parser.parse_args(argv))
    except SlamdepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    return 0


def train_from_images(options: argparse.Namespace) -> None:
    """Train on the images in ``options.data`` and write ``options.output``.

    Raises:
        DatasetError: there are no images, or too few features for that many words.
        OutputError: the output is no .npz file, or its folder does not exist.
    """
    if options.output.suffix != ".npz" or not options.output.parent.is_dir():
        raise OutputError(f"{options.output}: --output must be a .npz file in a folder that exists")
    images = read_descriptors(options.data, options.exclude, options.features)
    total = sum(len(image) for image in images)
    logger.info("%d descriptors of %d images", total, len(images))
    description = (
        f"{options.branches}x{options.leaves} binary words from {total} ORB descriptors of {len(images)} "
        f"images in {options.data.name} without {', '.join(options.exclude) or 'exception'}; "
        f"python data_scripts/train_vocabulary.py --branches {options.branches} "
        f"--leaves {options.leaves} --features {options.features} "
        f"--seed {options.seed}"
    )
    try:
        vocabulary = train_vocabulary(images, options.branches, options.leaves, options.seed, description)
    except ValueError as error:
        raise DatasetError(f"{options.data}: {error}") from error
    vocabulary.save(options.output)
    logger.info("%s: %d words written", options.output, len(vocabulary))


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    sys.exit(main())
