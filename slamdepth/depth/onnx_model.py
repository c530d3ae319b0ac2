# SPDX-License-Identifier: Apache-2.0
"""Any depth network as an ONNX file, run by ONNX Runtime (an optional dependency).

Nothing in an ONNX graph says what its values mean, so its author must: in the entry ``slamdepth`` of the
file's metadata, or in a text file next to it called ``FILE.onnx.json``. Both are a JSON object with

    kind         "metric depth", "affine depth" or "affine inverse depth"; needed
    input_size   [rows, columns] the network was trained on; needed where the graph leaves it open
    multiple     where the graph leaves the size open, sides are multiples of this (14)
    focal_px     focal length of the training images at that size; metric depth only
    mean, std    of the input in 0..1, three numbers each (ImageNet's)
    licence, trained_on

The graph takes one image ``(1, 3, rows, columns)``, RGB, and its first output is the map.
"""

from __future__ import annotations

import importlib
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from slamdepth.depth.card import ModelCard, Side, StatedFacts
from slamdepth.depth.network import NetworkDepth
from slamdepth.depth.preprocess import resize_rgb
from slamdepth.errors import ConfigError, WeightsError
from slamdepth.io import sha256_of
from slamdepth.types import DepthKind, WeightsInfo

METADATA_KEY = "slamdepth"
_KINDS = ", ".join(f'"{kind.value}"' for kind in DepthKind)

Three = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]


class OnnxAbout(StatedFacts):
    """What the author of an ONNX file says of it, as JSON; ``input_size`` is needed where the graph leaves it
    open.

    Attributes:
        multiple: where the graph leaves the size open, sides are multiples of this.
        mean, std: of the input in 0..1, for each of the channels R, G, B.
    """

    multiple: Side = 14
    mean: Three = (0.485, 0.456, 0.406)
    std: tuple[Positive, Positive, Positive] = (0.229, 0.224, 0.225)


class OnnxDepth(NetworkDepth):
    """A depth network in an ONNX file as a depth model.

    Args:
        session: an ONNX Runtime session.
        about: what the file says of itself.
        card: kind, input size, focal length and origin of the network.
        weights: the file.
        device: where it runs.
        is_fixed: the input has exactly the size of the card; else about its area, in the image's aspect.
    """

    def __init__(
        self,
        session: Any,
        about: OnnxAbout,
        card: ModelCard,
        weights: tuple[WeightsInfo, ...],
        device: str = "cpu",
        *,
        is_fixed: bool = True,
    ) -> None:
        super().__init__(card, weights, device)
        self._session = session
        self._about = about
        self._is_fixed = is_fixed
        self._input = session.get_inputs()[0].name
        self._output = session.get_outputs()[0].name

    @classmethod
    def load(cls, path: Path, *, device: str = "cpu") -> OnnxDepth:
        """Open an ONNX file.

        Raises:
            WeightsError: the file is missing or unreadable, does not say what its values mean, or takes
                another input.
            ConfigError: ONNX Runtime is not installed, or has no such device.
        """
        if not path.is_file():
            raise WeightsError(f"{path}: no such ONNX file")
        session = _open(path, device)
        about = _about(path, session.get_modelmeta().custom_metadata_map)
        size, is_fixed = _input_size(path, session, about)
        card = ModelCard(f"onnx:{path}", about.kind, size, about.focal_px, about.licence, about.trained_on)
        info = WeightsInfo(path.stem, sha256_of(path), about.trained_on, about.licence)
        return cls(session, about, card, (info,), device, is_fixed=is_fixed)

    def infer(self, image_rgb: NDArray[np.uint8]) -> tuple[NDArray[np.float32], tuple[int, int]]:
        """Run the network on an RGB image ``(H, W, 3)``.

        Returns:
            The network's values ``(H, W)`` at the image's own resolution, and the rows and columns that the
            image was resized to.

        Raises:
            WeightsError: the graph does not run on the image, or its output is not one map.
        """
        import cv2

        height, width = image_rgb.shape[:2]
        rows, columns = self.card.native_size
        if not self._is_fixed:
            scale = math.sqrt(rows * columns / (height * width))
            multiple = self._about.multiple
            rows, columns = (max(1, round(side * scale / multiple)) * multiple for side in (height, width))
        image = resize_rgb(image_rgb, rows, columns).astype(np.float32) / 255.0
        mean: NDArray[np.float32] = np.array(self._about.mean, dtype=np.float32)
        std: NDArray[np.float32] = np.array(self._about.std, dtype=np.float32)
        image = (image - mean) / std
        image = np.ascontiguousarray(image.transpose(2, 0, 1)[None])
        try:
            found = self._session.run([self._output], {self._input: image})
        except Exception as error:  # ONNX Runtime's errors have no common base class
            raise WeightsError(
                f"{self.name}: does not run on an image {image.shape}: {_first_line(error)}"
            ) from error
        out = np.asarray(found[0], dtype=np.float32)
        if out.ndim < 2 or out.size != out.shape[-2] * out.shape[-1]:
            raise WeightsError(
                f"{self.name}: the first output is {out.shape}, not one map (1, 1, rows, columns)"
            )
        out = out.reshape(out.shape[-2:])
        values = cv2.resize(out, (width, height), interpolation=cv2.INTER_LINEAR)
        return np.asarray(values, dtype=np.float32), (rows, columns)


def _open(path: Path, device: str) -> Any:
    try:
        onnxruntime = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise ConfigError(
            "depth by an ONNX file needs ONNX Runtime: install it with pip install 'slamdepth[onnx]'"
        ) from error
    provider = "CUDAExecutionProvider" if device.startswith("cuda") else "CPUExecutionProvider"
    if provider not in onnxruntime.get_available_providers():
        raise ConfigError(
            f"device '{device}': this ONNX Runtime has no {provider}; use 'cpu' or onnxruntime-gpu"
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=[provider])
    except Exception as error:  # ONNX Runtime's errors have no common base class
        raise WeightsError(f"{path}: not a readable ONNX file: {_first_line(error)}") from error


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def _about(path: Path, metadata: dict[str, str]) -> OnnxAbout:
    sidecar = path.with_name(path.name + ".json")
    if sidecar.is_file():
        return OnnxAbout.read(sidecar)
    if (text := metadata.get(METADATA_KEY)) is None:
        raise WeightsError(
            f"{path}: does not say what its values mean; write {sidecar} with at least "
            f'{{"kind": K}}, K being one of {_KINDS}'
        )
    return OnnxAbout.parse(text, f"{path}, metadata '{METADATA_KEY}'")


def _input_size(path: Path, session: Any, about: OnnxAbout) -> tuple[tuple[int, int], bool]:
    """Rows and columns of the network's input, and whether the graph fixes them."""
    inputs = session.get_inputs()
    shape = list(inputs[0].shape) if inputs else []
    fixed = [size for size in zip(shape[:2], (1, 3), strict=False) if isinstance(size[0], int)]
    if len(inputs) != 1 or len(shape) != 4 or any(found != needed for found, needed in fixed):
        raise WeightsError(
            f"{path}: takes {[(i.name, i.shape) for i in inputs]}, not one image (1, 3, rows, columns)"
        )
    if inputs[0].type != "tensor(float)":
        raise WeightsError(f"{path}: takes {inputs[0].type}, not tensor(float)")
    if all(isinstance(side, int) and side > 0 for side in shape[2:]):
        return (shape[2], shape[3]), True
    if about.input_size is None:
        raise WeightsError(f"{path}: leaves its input size open; say 'input_size' [rows, columns]")
    return about.input_size, False


def create(path: str, *, device: str = "cpu", seed: int = 0) -> OnnxDepth:
    """The model in the ONNX file at ``path``; nothing in it is random, so ``seed`` has no effect."""
    del seed
    return OnnxDepth.load(Path(path), device=device)
