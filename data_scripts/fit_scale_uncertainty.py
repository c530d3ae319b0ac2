#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Fit how sure a depth head is of the scale of an image, from its errors in places it was not trained on.

    python data_scripts/fit_scale_uncertainty.py HEAD OUTPUT --known DIR... --unseen DIR... [--seen DIR...]

A DIR is a folder of images with depth as for ``slamdepth eval-depth``. The depth of the head stays as it is.
Neighbouring pairs of a folder of ``--unseen`` show the same place: four in a row count as one. The same
arguments give the same bytes.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from slamdepth.depth import weights as store
from slamdepth.depth.dinov2 import load_dinov2
from slamdepth.depth.head import load_head, save_head
from slamdepth.depth.scale_uncertainty import ScaleUncertainty
from slamdepth.errors import SlamdepthError
from slamdepth.pipeline.depth_data import open_depth_data, readable, thinned
from slamdepth.training.scale_errors import ScaleErrors, View, fit_scale_uncertainty, look
from slamdepth.types import Frame

logger = logging.getLogger(__name__)

_IN_A_ROW = 4
_KNOWN_PER_PLACE = 40


def frames_of(folders: Sequence[str], most: int | None = None) -> Iterator[tuple[int, Frame]]:
    """Number of the place and frame, of all folders; of each at most so many, spread evenly."""
    first = 0
    for folder in folders:
        for place in open_depth_data(Path(folder)):
            chosen = thinned(place, max_frames=most)
            for k, frame in enumerate(readable(place, chosen)):
                yield first + k // _IN_A_ROW, frame
            first += len(chosen) // _IN_A_ROW + 1
            logger.info("%s: %d images", place.name, len(chosen))


def described(name: str, network: ScaleUncertainty, errors: ScaleErrors) -> str:
    """A row: median error and sigma, infinite ones, and the share of errors within one and two sigmas."""
    sigma = errors.sigma(network)
    known = torch.isfinite(sigma)
    ratio = errors.error[known].abs() / sigma[known]
    shares = [float((ratio <= k).double().mean()) if len(ratio) else math.nan for k in (1, 2)]
    median = float(sigma.quantile(0.5, interpolation="higher"))
    unknown = int((~known).sum())
    return (
        f"| {name} | {len(sigma)} | {float(errors.error.median()):+.3f} | {median:.3f} | {unknown} | "
        f"{shares[0]:.2f} | {shares[1]:.2f} |"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("head", type=Path, help="a depth head")
    parser.add_argument("output", type=Path, help="the head with the uncertainty of its scale")
    parser.add_argument("--known", nargs="+", required=True, metavar="DIR", help="what it was trained on")
    parser.add_argument(
        "--unseen", nargs="+", required=True, metavar="DIR", help="what it was not trained on"
    )
    parser.add_argument(
        "--seen",
        nargs="*",
        default=[],
        metavar="DIR",
        help="many places that it was trained on; they tell how far images of their kind are from others",
    )
    parser.add_argument("--check", nargs="*", default=[], metavar="DIR", help="only judged")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        backbone = load_dinov2(store.find_backbone(None))
        head, about = load_head(given.head)
        known = look(backbone, head, frames_of(given.known, _KNOWN_PER_PLACE))
        unseen, seen = (look(backbone, head, frames_of(folders)) for folders in (given.unseen, given.seen))
        network, errors = fit_scale_uncertainty(known, unseen, seen)
        checked: list[tuple[str, list[View]]] = [
            (Path(folder).name, look(backbone, head, frames_of([folder]))) for folder in given.check
        ]
        head.scale = network
        head.shape = replace(head.shape, subspace_dim=len(network.basis))
        about = {key: value for key, value in about.items() if key not in ("format", "shape", "sigma_scale")}
        about["scale_uncertainty"] = json.dumps([Path(folder).name for folder in given.unseen])
        save_head(given.output, head, about)
    except (SlamdepthError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print("| images | count | median log error | median sigma | infinite | within 1 sigma | within 2 |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    print(described("unseen, from the subspace of the others", network, errors))
    for name, seen in checked:
        if seen:
            print(described(name, network, ScaleErrors.of(network, seen)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
