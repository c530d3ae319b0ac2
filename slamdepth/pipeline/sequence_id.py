# SPDX-License-Identifier: Apache-2.0
"""An identifier of a sequence that does not depend on where it lies or what its folder is called."""

from __future__ import annotations

import numpy as np

from slamdepth.datasets import Dataset
from slamdepth.datasets.sequence import ImageSequence, is_file
from slamdepth.datasets.virtual_view import ViewedSequence
from slamdepth.training.data import fingerprint


def sequence_id(dataset: Dataset) -> str:
    """Short hash of the times of ``dataset`` and of the names and sizes of its images.

    Names of folders are not enough: all sequences of 7-Scenes are called seq-NN.
    """
    if isinstance(dataset, ViewedSequence):
        dataset = dataset.raw
    if isinstance(dataset, ImageSequence):
        files = [path for path in dataset.image_paths if is_file(path)]
    else:
        files = [dataset.path] if is_file(dataset.path) else []
    return fingerprint(files, np.asarray(dataset.timestamps_s).tolist())
