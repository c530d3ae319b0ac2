# SPDX-License-Identifier: Apache-2.0
"""Place recognition on real sequences: bag of words, DINOv2 tokens, and the tracker's verification.

    python -m benchmarks.places --data DIR --sequences rgbd_dataset_freiburg1_desk --output places.json

Every frame is a query for earlier frames of the same place; true poses and depth say which answers are
right. See ``docs/benchmarks.md`` for the columns of the table.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from benchmarks import places_methods as methods
from benchmarks.command import comma_separated, errors_in_one_line, parser_of, progress_line
from benchmarks.markdown import markdown_table
from benchmarks.places_scores import score_answers
from benchmarks.places_truth import labels, overlaps
from benchmarks.record import environment, write_benchmark
from benchmarks.slam import find_sequences
from slamdepth.config import Config
from slamdepth.datasets import Dataset
from slamdepth.depth.base import DepthModel
from slamdepth.depth.registry import create_depth_model
from slamdepth.depth.sensor import SensorDepth
from slamdepth.errors import ConfigError, DatasetError
from slamdepth.io import write_text
from slamdepth.typing import Floats32

if TYPE_CHECKING:
    from numpy.typing import NDArray

_POSE_WITHIN_S = 0.02
_TOLERANCE = {"sensor": 0.1, "predicted": 0.3}
_COLUMNS = (
    ("average precision", "average_precision", 3),
    ("recall at 100 % precision", "recall_at_full_precision", 3),
    ("recall@1", "recall_at_1", 3),
    ("recall@5", "recall_at_5", 3),
    ("CPU ms/query", "cpu_ms", 2),
)


def read_places(dataset: Dataset, stride: int, max_frames: int | None, config: Config) -> list[methods.Place]:
    """Read every ``stride``-th frame that has a true pose and depth, with DINOv2's tokens if it is there.

    Raises:
        DatasetError: there is no ground truth, or fewer than two such frames.
    """
    truth = dataset.ground_truth
    if truth is None:
        raise DatasetError(f"{dataset.path}: has no ground truth to judge places by")
    model: DepthModel = SensorDepth() if dataset.has_depth else create_depth_model("dinov2")
    tokens = _Tokens.load()
    places = []
    for index in range(0, min(len(dataset), max_frames or len(dataset)), stride):
        nearest = int(np.argmin(np.abs(truth.timestamps_s - dataset.timestamps_s[index])))
        if abs(truth.timestamps_s[nearest] - dataset.timestamps_s[index]) > _POSE_WITHIN_S:
            continue
        frame = dataset.read(index, with_depth=dataset.has_depth)
        if dataset.has_depth and frame.depth_m is None:
            continue
        means, classes = tokens.of(frame.image_rgb) if tokens else ((), ())
        places.append(
            methods.Place(
                frame,
                methods.features_of(frame, config),
                model.predict(frame),
                truth.T_world_camera[nearest],
                means,
                classes,
            )
        )
    if len(places) < 2:
        raise DatasetError(f"{dataset.path}: fewer than two frames have a true pose and depth")
    return places


class _Tokens:
    """DINOv2's tokens of an image; predicting a keyframe's depth makes them in any case."""

    def __init__(self, backbone: Any) -> None:
        from slamdepth.depth.dinov2 import working_type

        self._dtype = working_type("cpu")
        self._backbone = backbone.to(self._dtype)

    @classmethod
    def load(cls) -> _Tokens | None:
        """Load the backbone; None, and a line on standard error, where its weights are missing."""
        from slamdepth.depth.dinov2 import load_dinov2
        from slamdepth.depth.weights import find_backbone
        from slamdepth.errors import WeightsError

        try:
            return cls(load_dinov2(find_backbone()))
        except WeightsError as error:
            progress_line(f"without DINOv2's rows: {error}")
            return None

    def of(self, image_rgb: NDArray[np.uint8]) -> tuple[tuple[Floats32, ...], tuple[Floats32, ...]]:
        """The mean of the normalised patch tokens and the class token, ``(384,)``, after each of the taps."""
        import torch

        from slamdepth.depth.preprocess import input_size, normalised, resize_rgb

        rows, columns = input_size(*image_rgb.shape[:2])
        image = normalised(resize_rgb(image_rgb, rows, columns)[None], "cpu")
        with torch.inference_mode():
            tapped = self._backbone(image.to(self._dtype), methods.TAPS)
        means = tuple(
            torch.nn.functional.normalize(grid[0].flatten(1).float(), dim=0).mean(dim=1).numpy()
            for grid, _ in tapped
        )
        return means, tuple(token[0].float().numpy() for _, token in tapped)


def earlier_frames(timestamps_s: Sequence[float], apart_s: float) -> dict[int, list[int]]:
    """For each frame the frames at least ``apart_s`` older; frames without any are left out."""
    found = {q: [k for k in range(q) if t - timestamps_s[k] >= apart_s] for q, t in enumerate(timestamps_s)}
    return {q: frames for q, frames in found.items() if frames}


def answerers(
    places: Sequence[methods.Place], dataset: Dataset, config: Config, min_gap: int
) -> Iterator[tuple[str, methods.Answer]]:
    """The methods of the table by their names in it."""
    yield "bag of ORB words", methods.bag_of_words(places)
    if places[0].means:
        for t, tap in enumerate(methods.TAPS):
            yield f"DINOv2 class token, block {tap}", methods.vectors([p.classes[t] for p in places])
        for t, tap in enumerate(methods.TAPS):
            yield f"DINOv2 mean patch token, block {tap}", methods.vectors([p.means[t] for p in places])
    yield "bag, verified as by the tracker", methods.verified(places, dataset.camera, config, min_gap)


def judge(
    name: str, dataset: Dataset, *, stride: int, max_frames: int | None, apart_s: float
) -> list[dict[str, Any]]:
    """The rows of one sequence, one for each method."""
    config = Config()
    places = read_places(dataset, stride, max_frames, config)
    depth = "sensor" if dataset.has_depth else "predicted"
    overlap = overlaps(
        dataset.camera, [p.depth.values for p in places], np.stack([p.T_world_camera for p in places]),
        tolerance=_TOLERANCE[depth],
    )  # fmt: skip
    truth = labels(overlap)
    earlier = earlier_frames([p.frame.timestamp_s for p in places], apart_s)
    if not earlier:
        raise DatasetError(f"{dataset.path}: is shorter than --apart {apart_s:g} s")
    min_gap = min(q - max(frames) for q, frames in earlier.items())
    rows = []
    for method, answer in answerers(places, dataset, config, min_gap):
        answers, cpu_ms = methods.ask(answer, earlier)
        score = score_answers(answers, truth, earlier)
        figures = {key: value for key, value in asdict(score).items() if key != "curve"}
        rows.append(
            {
                "sequence": name,
                "method": method,
                "frames": len(places),
                "overlap_from": f"{depth} depth",
                "figures": {**figures, "cpu_ms": cpu_ms},
                "curve": score.curve.tolist(),
            }
        )
    return rows


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as Markdown."""
    headings = ["sequence", "method", "queries", "seen before", *(heading for heading, _, _ in _COLUMNS)]
    lines = []
    for row in rows:
        figures = row["figures"]
        cells = [f"{figures[key]:.{digits}f}" for _, key, digits in _COLUMNS]
        counts = [str(figures["queries"]), str(figures["known"])]
        lines.append([row["sequence"], row["method"], *counts, *cells])
    return markdown_table(headings, lines)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """The command line."""
    parser = parser_of("places", __doc__)
    add = parser.add_argument
    add("--data", type=Path, required=True, help="folder that holds the sequences")
    add("--sequences", type=comma_separated, help="their names, with commas (default: all in --data)")
    add("--stride", type=int, default=10, help="take every Nth frame")
    add("--max-frames", type=int)
    add("--apart", type=float, default=3.0, metavar="S", help="an answer is at least S seconds older")
    add("--output", type=Path, help=".json to write; table (.md) and plot (.svg) get the same name")
    return parser.parse_args(arguments)


@errors_in_one_line
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = parse(arguments)
    if options.stride < 1 or options.apart < 0:
        raise ConfigError("--stride must be at least 1 and --apart no less than 0")
    begun = environment()
    rows: list[dict[str, Any]] = []
    for name, dataset in find_sequences(options.data, options.sequences).items():
        progress_line(f"{name}: reading every {options.stride}th frame")
        rows += judge(
            name, dataset,
            stride=options.stride, max_frames=options.max_frames, apart_s=options.apart,
        )  # fmt: skip
        if options.output:
            _write(options, begun, rows)
    print(table(rows))
    return 0


def _write(options: argparse.Namespace, begun: dict[str, Any], rows: Sequence[Mapping[str, Any]]) -> None:
    from benchmarks.places_plot import write_precision_recall

    settings = {"stride": options.stride, "max_frames": options.max_frames, "apart_s": options.apart}
    write_benchmark(options.output, begun, settings, rows=rows)
    write_text(options.output.with_suffix(".md"), table(rows) + "\n")
    write_precision_recall(options.output.with_suffix(".svg"), rows)


if __name__ == "__main__":
    sys.exit(main())
