# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: checkerboards and ChArUco boards, how they are named, and where an image shows them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from slamdepth.errors import ConfigError
from slamdepth.fiducial import FAMILIES
from slamdepth.typing import Bools, Bytes, Floats, Ints

DEFAULT_BOARD, DEFAULT_SQUARE_MM = "charuco:10x7", 25.0
"""What ``slamdepth calibrate --print`` prints where no board is named; it fits A4 and Letter."""

_CHARUCO, _CHECKERBOARD = "charuco", "checkerboard"
_DEFAULT_FAMILY = "DICT_4X4_50"
_SPEC = re.compile(r"(?:([a-z]+):)?(\d+)x(\d+)(?::([A-Za-z0-9_]+))?(?::([0-9.]+))?", re.IGNORECASE)
_FEWEST, _MOST = 3, 60
_FEWEST_CORNERS = 8
_SMALLEST_MM, _LARGEST_MM = 1.0, 2000.0
_HOW = "expected charuco:COLUMNSxROWS (squares) or checkerboard:COLUMNSxROWS (inner corners), such as"


@dataclass(frozen=True)
class Sighting:
    """What one image shows of a board.

    Attributes:
        ids: ``(N,)`` numbers of the corners, rows of :attr:`Board.corners_mm`.
        px: ``(N, 2)`` raw pixels.
    """

    ids: Ints
    px: Floats


@dataclass(frozen=True)
class Board:
    """A flat board of squares.

    Attributes:
        kind: "charuco" or "checkerboard".
        columns, rows: squares of a ChArUco board, inner corners of a checkerboard, as OpenCV counts them.
        square_mm: side of a square.
        family: of the markers of a ChArUco board, a name of :data:`slamdepth.fiducial.FAMILIES`.
        marker_share: side of a marker as a share of a square's.
    """

    kind: str
    columns: int
    rows: int
    square_mm: float
    family: str = _DEFAULT_FAMILY
    marker_share: float = 0.75

    @classmethod
    def parse(cls, text: str, square_mm: float = DEFAULT_SQUARE_MM) -> Board:
        """Read ``charuco:10x7``, ``charuco:10x7:FAMILY:SHARE``, ``checkerboard:9x6`` or ``9x6``.

        Raises:
            ConfigError: it is none of these, or the size of a square is impossible.
        """
        found = _SPEC.fullmatch(text.strip())
        kind = (found[1] or _CHECKERBOARD).lower() if found else ""
        if found is None or kind not in (_CHARUCO, _CHECKERBOARD):
            raise ConfigError(f"board {text!r}: {_HOW} {DEFAULT_BOARD}")
        columns, rows = int(found[2]), int(found[3])
        if not (min(columns, rows) >= _FEWEST and max(columns, rows) <= _MOST):
            raise ConfigError(f"board {text!r}: columns and rows must be {_FEWEST} to {_MOST}")
        if not _SMALLEST_MM <= square_mm <= _LARGEST_MM:
            raise ConfigError(
                f"--square-mm {square_mm:g}: must be {_SMALLEST_MM:g} to {_LARGEST_MM:g} millimetres"
            )
        family, share = found[4] or _DEFAULT_FAMILY, float(found[5] or 0.75)
        if kind == _CHECKERBOARD and found[4]:
            raise ConfigError(f"board {text!r}: a checkerboard has no markers; {_HOW} {DEFAULT_BOARD}")
        if family not in FAMILIES:
            raise ConfigError(f"board {text!r}: unknown family {family!r}; known: {', '.join(FAMILIES)}")
        if not 0.3 <= share <= 0.95:
            raise ConfigError(f"board {text!r}: markers must be 0.3 to 0.95 of a square")
        board = cls(kind, columns, rows, float(square_mm), family, share)
        markers = columns * rows // 2
        if kind == _CHARUCO and len(board._dictionary.bytesList) < markers:
            raise ConfigError(f"board {text!r}: needs {markers} markers, and {family} has fewer")
        return board

    @property
    def name(self) -> str:
        """The board as :meth:`parse` reads it."""
        plain = f"{self.kind}:{self.columns}x{self.rows}"
        is_usual = self.family == _DEFAULT_FAMILY and self.marker_share == 0.75
        return (
            plain
            if self.kind == _CHECKERBOARD or is_usual
            else f"{plain}:{self.family}:{self.marker_share:g}"
        )

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        more = 1 if self.kind == _CHECKERBOARD else 0
        return self.columns + more, self.rows + more

    @property
    def corners_mm(self) -> Floats:
        """Inner corners ``(N, 3)``: x right and y down from the board's top left, z 0."""
        columns, rows = self.squares
        x, y = np.meshgrid(np.arange(1, columns), np.arange(1, rows))
        grid = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
        return np.asarray(self.square_mm * grid, np.float64)

    @property
    def corner_grid(self) -> tuple[int, int]:
        """Rows and columns of inner corners."""
        columns, rows = self.squares
        return rows - 1, columns - 1

    def is_black(self) -> tuple[Bools, float]:
        """The board as a grid of cells ``(H, W)``, True where it is black, and the side of a cell in mm.

        A ChArUco board has markers of :attr:`marker_share` only where that is a whole number of cells, as
        the default is; OpenCV finds others too.
        """
        columns, rows = self.squares
        cells = 1
        if self.kind == _CHARUCO:
            bits = int(self._dictionary.markerSize) + 2
            cells = max(bits + 1, round(bits / self.marker_share))
            cells += (cells - bits) % 2
        x, y = np.arange(columns * cells) // cells, np.arange(rows * cells) // cells
        black = (x[None] + y[:, None]) % 2 == 0
        if self.kind == _CHARUCO:
            for number, (column, row) in enumerate(_white(columns, rows)):
                left, top = (column * cells + (cells - bits) // 2, row * cells + (cells - bits) // 2)
                marker = self._dictionary.generateImageMarker(number, bits)
                black[top : top + bits, left : left + bits] = np.asarray(marker) == 0
        return black, self.square_mm / cells

    def find(self, grey: Bytes) -> Sighting | None:
        """The corners that an image ``(H, W)`` uint8 shows; None where it shows too few of them."""
        found = self._find_charuco(grey) if self.kind == _CHARUCO else self._find_checkerboard(grey)
        if found is None or len(found.ids) < _FEWEST_CORNERS:
            return None
        width = self.corner_grid[1]
        if min(len(set(found.ids // width)), len(set(found.ids % width))) < 2:
            return None  # corners in one line say nothing
        return found

    def _find_charuco(self, grey: Bytes) -> Sighting | None:
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) == 0:
            return None
        px = np.asarray(corners, np.float64).reshape(-1, 2)
        return Sighting(np.asarray(ids, np.int64).ravel(), px)

    def _find_checkerboard(self, grey: Bytes) -> Sighting | None:
        import cv2

        flags = cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_ACCURACY
        found, corners = cv2.findChessboardCornersSB(grey, (self.columns, self.rows), flags=flags)
        if not found:
            return None
        px = np.asarray(corners, np.float64).reshape(-1, 2)
        return Sighting(np.arange(len(px), dtype=np.int64), px)

    @cached_property
    def _dictionary(self) -> Any:
        import cv2

        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, FAMILIES[self.family]))

    @cached_property
    def _detector(self) -> Any:
        import cv2

        side = float(self.square_mm)
        board = cv2.aruco.CharucoBoard(
            (self.columns, self.rows), side, side * self.marker_share, self._dictionary
        )
        return cv2.aruco.CharucoDetector(board)


def _white(columns: int, rows: int) -> list[tuple[int, int]]:
    """Columns and rows of the white squares, in the order in which OpenCV numbers their markers."""
    return [(x, y) for y in range(rows) for x in range(columns) if (x + y) % 2]
