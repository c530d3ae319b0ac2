# SPDX-License-Identifier: Apache-2.0
"""Train a vocabulary tree for ORB-SLAM3, whose own file has 140 MB.

The file has DBoW2's text format: ``branches depth 0 0``, then one line per node with its parent, 1 for a
leaf, 32 descriptor bytes and the weight.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from data_scripts.train_vocabulary import k_majority
from slamdepth.errors import DatasetError, ImageDecodeError
from slamdepth.io import write_text

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Descriptors = NDArray[np.uint8]

logger = logging.getLogger(__name__)

BRANCHES = 10
DEPTH = 6  # of ORB-SLAM's own file; matching by word looks four levels above the deepest leaf
MIN_SPLIT = 60  # nodes with fewer descriptors stay leaves
SAMPLE = 300_000
FEATURES = 1000


@dataclass(frozen=True)
class Node:
    """A node of the tree.

    Attributes:
        parent: number of the parent; 0 is the root.
        word: descriptor, 32 bytes.
        weight: inverse document frequency of a leaf, 0 for others.
    """

    parent: int
    word: Descriptors
    is_leaf: bool
    weight: float


def train_tree(
    images: Sequence[Descriptors], *, seed: int = 0, branches: int = BRANCHES, depth: int = DEPTH
) -> list[Node]:
    """Hierarchical k-majority clustering of the descriptors ``(N_i, 32)`` of each image.

    Returns:
        The nodes below the root in the order of their numbers, from 1; parents come before children.
    """
    rng = np.random.default_rng(seed)
    descriptors = np.concatenate(list(images))
    image_of = np.repeat(np.arange(len(images)), [len(image) for image in images])
    if len(descriptors) > SAMPLE:
        kept = np.sort(rng.choice(len(descriptors), SAMPLE, replace=False))
        descriptors, image_of = descriptors[kept], image_of[kept]
    nodes: list[Node] = []
    waiting = [(0, 0, np.arange(len(descriptors)))]
    while waiting:
        parent, level, members = waiting.pop(0)
        centres, cluster = k_majority(descriptors[members], branches, rng, iterations=10)
        for k in range(branches):
            inside = members[cluster == k]
            if len(inside) == 0:
                continue
            splits = (
                level + 1 < depth and len(inside) >= MIN_SPLIT and _distinct(descriptors[inside], branches)
            )
            seen_in = len(np.unique(image_of[inside]))
            weight = 0.0 if splits else float(np.log(len(images) / seen_in))
            nodes.append(Node(parent, centres[k], not splits, weight))
            if splits:
                waiting.append((len(nodes), level + 1, inside))
    return nodes


def write_tree(path: Path, nodes: Sequence[Node], *, branches: int = BRANCHES, depth: int = DEPTH) -> None:
    """Write the tree for DBoW2, without a newline at the end, which DBoW2 would read as a node."""
    lines = [f"{branches} {depth} 0 0"]
    for node in nodes:
        word = " ".join(map(str, node.word))
        lines.append(f"{node.parent} {int(node.is_leaf)} {word} {node.weight:.6g}")
    write_text(path, "\n".join(lines))


def train_vocabulary_file(images: Sequence[Path], output: Path) -> None:
    """Train on colour images and write ``output``.

    Raises:
        DatasetError: the images have fewer than 1,000 features.
    """
    import cv2

    from slamdepth.io import read_image_rgb

    orb = cv2.ORB.create(nfeatures=FEATURES, fastThreshold=7)
    found: list[Descriptors] = []
    for path in images:
        try:
            gray = cv2.cvtColor(read_image_rgb(path), cv2.COLOR_RGB2GRAY)
        except ImageDecodeError as error:
            logger.warning("skipped for the vocabulary: %s", error)
            continue
        _, descriptors = orb.detectAndCompute(gray, None)
        if descriptors is not None:
            found.append(np.asarray(descriptors, dtype=np.uint8))
    if sum(map(len, found)) < 1000:
        raise DatasetError("the vocabulary cannot be trained: too few features in the colour images")
    nodes = train_tree(found)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_tree(output, nodes)
    leaves = sum(node.is_leaf for node in nodes)
    logger.info("%s: %d words from %d images", output, leaves, len(found))


def _distinct(descriptors: Descriptors, count: int) -> bool:
    return len(np.unique(descriptors, axis=0)) >= count
