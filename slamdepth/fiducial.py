# SPDX-License-Identifier: Apache-2.0
"""AprilTag and ArUco markers of known size: how they are named, and where an image shows them."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import ConfigError

if TYPE_CHECKING:
    from numpy.typing import NDArray

FAMILIES = {
    "tag16h5": "DICT_APRILTAG_16h5",
    "tag25h9": "DICT_APRILTAG_25h9",
    "tag36h10": "DICT_APRILTAG_36h10",
    "tag36h11": "DICT_APRILTAG_36h11",
    **{
        f"DICT_{n}X{n}_{count}": f"DICT_{n}X{n}_{count}"
        for n in (4, 5, 6, 7)
        for count in (50, 100, 250, 1000)
    },
    "DICT_ARUCO_ORIGINAL": "DICT_ARUCO_ORIGINAL",
    "DICT_ARUCO_MIP_36h12": "DICT_ARUCO_MIP_36h12",
}
"""Names of marker families, and those of OpenCV for them."""

_SPEC = re.compile(r"([^:]+):([^:]+)(?::([^:]+))?")
_LARGEST_M = 100.0
_REACH_PX = 3.0  # of the search for an edge


@dataclass(frozen=True)
class MarkerSpec:
    """Markers of one family and size.

    Attributes:
        family: one of :data:`FAMILIES`.
        side_m: side of the black square in metres, without the white margin.
        id: number of the marker; None takes every one of the family.
    """

    family: str
    side_m: float
    id: int | None = None

    @classmethod
    def parse(cls, text: str) -> MarkerSpec:
        """Read ``FAMILY:SIDE`` or ``FAMILY:SIDE:NUMBER``, such as ``tag36h11:0.16``.

        Raises:
            ConfigError: it is none; says what is wrong and lists the families.
        """
        found = _SPEC.fullmatch(text.strip())
        if found is None:
            raise ConfigError(
                f"marker {text!r}: expected FAMILY:SIDE in metres, such as tag36h11:0.16, or "
                "FAMILY:SIDE:NUMBER"
            )
        family, side, number = found.groups()
        if family not in FAMILIES:
            raise ConfigError(f"marker {text!r}: unknown family {family!r}; known: {', '.join(FAMILIES)}")
        try:
            side_m, chosen = float(side), None if number is None else int(number)
        except ValueError:
            raise ConfigError(f"marker {text!r}: side and number must be numbers") from None
        if not (math.isfinite(side_m) and 0 < side_m <= _LARGEST_M):
            raise ConfigError(f"marker {text!r}: the side must be between 0 and {_LARGEST_M:g} metres")
        spec = cls(family, side_m, chosen)
        count = len(spec.dictionary().bytesList)
        if chosen is not None and not 0 <= chosen < count:
            raise ConfigError(f"marker {text!r}: {family} has the numbers 0 to {count - 1}")
        return spec

    def dictionary(self) -> Any:
        """OpenCV's dictionary of the family."""
        import cv2

        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[self.family]))

    def __str__(self) -> str:
        return self.family if self.id is None else f"{self.family} {self.id}"


class MarkerDetector:
    """Finds the markers of one family in images.

    Args:
        spec: which markers.
    """

    def __init__(self, spec: MarkerSpec) -> None:
        import cv2

        self._spec = spec
        self._detector = cv2.aruco.ArucoDetector(spec.dictionary(), cv2.aruco.DetectorParameters())

    def find(self, image_rgb: NDArray[np.uint8]) -> dict[int, NDArray[np.float64]]:
        """Corners ``(4, 2)`` in raw pixels by number of each marker that an ``(H, W, 3)`` image shows once.

        They start at the marker's own top left and go round clockwise.
        """
        import cv2

        grey = np.asarray(cv2.cvtColor(image_rgb, cv2.COLOR_RGB2GRAY), dtype=np.uint8)
        corners, numbers, _ = self._detector.detectMarkers(grey)
        if numbers is None:
            return {}
        found: dict[int, list[NDArray[np.float64]]] = {}
        for number, four in zip(np.ravel(numbers).tolist(), corners, strict=True):
            found.setdefault(number, []).append(np.asarray(four, dtype=np.float64).reshape(4, 2))
        wanted = found if self._spec.id is None else {self._spec.id: found.get(self._spec.id, [])}
        return {number: _refined(grey, seen[0]) for number, seen in wanted.items() if len(seen) == 1}


def _refined(grey: NDArray[np.uint8], corners: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners ``(4, 2)`` as the crossings of lines through the edges of the black square.

    OpenCV's own refinement searches the corner in a window, which pulls blurred corners of a square inwards:
    by 1 % of the side of a marker 50 pixels wide.
    """
    for _ in range(2):
        inside = corners.mean(axis=0)
        found = (_edge(grey, corners[k], corners[(k + 1) % 4], inside) for k in range(4))
        lines = [line for line in found if line is not None]
        if len(lines) < 4:
            return corners
        crossed = np.array([np.cross(a, b) for a, b in zip(lines[-1:] + lines[:-1], lines, strict=True)])
        moved = crossed[:, :2] / crossed[:, 2:]
        if not np.all(np.abs(moved - corners) < 2 * _REACH_PX):  # False for NaN
            return corners
        corners = moved
    return corners


def _edge(
    grey: NDArray[np.uint8], a: NDArray[np.float64], b: NDArray[np.float64], inside: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The line ``(3,)``, homogeneous, along which the image gets brighter between two corners."""
    import cv2

    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    outwards = np.array([along[1], -along[0]])
    outwards *= np.sign(outwards @ (a - inside))
    steps = np.arange(-_REACH_PX, _REACH_PX + 0.01, 0.25)
    foot = a + np.linspace(0.12, 0.88, max(8, int(np.linalg.norm(b - a))))[:, None] * (b - a)
    at = (foot[:, None] + steps[:, None] * outwards).astype(np.float32)
    values = cv2.remap(grey.astype(np.float32), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
    slope = np.maximum(np.diff(values, axis=1), 0.0) ** 2
    total = slope.sum(axis=1)
    clear = total > 0.1 * np.median(total)
    if np.count_nonzero(clear) < 5 or total.max() <= 0:
        return None
    offset = slope[clear] @ ((steps[1:] + steps[:-1]) / 2) / total[clear]
    points = (foot[clear] + offset[:, None] * outwards).astype(np.float32)
    vx, vy, x, y = cv2.fitLine(points, cv2.DIST_HUBER, 0, 0.01, 0.01).ravel().astype(np.float64)
    return np.array([vy, -vx, vx * y - vy * x])
