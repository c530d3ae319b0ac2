# SPDX-License-Identifier: Apache-2.0
"""Furniture of the Sweet Home 3D libraries: a catalogue of real sizes, and OBJ meshes with textures.

Debian's packages ``sweethome3d`` (GPL) and ``sweethome3d-furniture`` (CC-BY 3.0, CC0) hold 1,000 models.
They need not be installed. To make the folder for :func:`read_catalogues`:

    apt-get download sweethome3d sweethome3d-furniture
    for file in *.deb; do dpkg -x $file unpacked; done
    for file in unpacked/usr/share/sweethome3d/furniture/*.sh3f unpacked/usr/share/sweethome3d/*.jar; do
        unzip -qo $file -d furniture/$(basename ${file%.*}); done
"""

from __future__ import annotations

import functools
import itertools
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

_MAX_OBJ_BYTES = 2_500_000  # larger meshes are finer than any view needs
_MAX_TEXTURE_PX = 256
_GLASS_OPACITY = 0.6  # materials of less opacity are left out as glass
_ENTRY = re.compile(r"(\w+)#(\d+)=(.*)")


@dataclass(frozen=True)
class Piece:
    """An entry of a catalogue.

    Attributes:
        size_m: width, depth and height; its back is towards +y, its front towards -y.
        elevation_m: height of its base above the floor if it hangs, else 0.
        top_m: height above its base at which things can stand on it, or None.
        rotation: ``(3, 3)`` to be applied to the model (y up) before it is scaled.
    """

    name: str
    category: str
    model: Path
    size_m: tuple[float, float, float]
    elevation_m: float
    top_m: float | None
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class Material:
    """Appearance of a surface.

    Attributes:
        image: ``(h, w, 3)`` float32 sRGB 0 to 1; repeats.
        emission: above 0, the surface emits its image times this factor and is not lit.
    """

    image: np.ndarray
    emission: float = 0.0


@dataclass(frozen=True)
class Mesh:
    """Triangles with materials.

    Attributes:
        corners: ``(T, 3, 3)`` metres, z up.
        uv: ``(T, 3, 2)`` in images, x to the right and y down.
        material: ``(T,)`` index into ``materials``.
    """

    corners: np.ndarray
    uv: np.ndarray
    material: np.ndarray
    materials: tuple[Material, ...]

    def moved(self, A: np.ndarray, t: np.ndarray) -> Mesh:
        """The mesh after the linear map ``A (3, 3)`` and the shift ``t (3,)``."""
        return Mesh(self.corners @ A.T + t, self.uv, self.material, self.materials)


def joined(meshes: list[Mesh]) -> Mesh:
    """All ``meshes`` as one."""
    starts = np.cumsum([0] + [len(m.materials) for m in meshes])
    return Mesh(
        np.concatenate([m.corners for m in meshes]).astype(np.float32),
        np.concatenate([m.uv for m in meshes]).astype(np.float32),
        np.concatenate([m.material + start for m, start in zip(meshes, starts, strict=False)]).astype(
            np.int32
        ),
        tuple(material for m in meshes for material in m.materials),
    )


def read_catalogues(folder: Path) -> list[Piece]:
    """Every piece of the unpacked libraries in ``folder``, in a fixed order."""
    pieces = []
    for file in sorted(folder.rglob("*FurnitureCatalog.properties")):
        root = next(parent for parent in file.parents if parent.parent == folder)
        entries: dict[int, dict[str, str]] = defaultdict(dict)
        for line in file.read_text(encoding="latin-1").splitlines():
            if match := _ENTRY.match(line.strip()):
                entries[int(match[2])][match[1]] = match[3]
        for number in sorted(entries):
            piece = _piece(root, entries[number])
            if piece is not None:
                pieces.append(piece)
    return pieces


def _piece(root: Path, entry: dict[str, str]) -> Piece | None:
    model = root / entry.get("model", "").lstrip("/")
    if not model.is_file() or model.suffix.lower() != ".obj" or model.stat().st_size > _MAX_OBJ_BYTES:
        return None
    size = tuple(float(entry[key]) / 100 for key in ("width", "depth", "height"))
    top = float(entry.get("dropOnTopElevation", 100 * size[2])) / 100
    rotation = np.array(entry.get("modelRotation", "1 0 0 0 1 0 0 0 1").split(), dtype=float)
    return Piece(
        entry.get("name", ""), entry.get("category", ""), model, (size[0], size[1], size[2]),
        float(entry.get("elevation", 0)) / 100, top if top >= 0 else None,
        tuple(map(tuple, rotation.reshape(3, 3))),
    )  # fmt: skip


@functools.lru_cache(maxsize=300)
def load_mesh(piece: Piece) -> Mesh | None:
    """The mesh of ``piece`` at its real size, centred over the origin; None if the file has no faces."""
    text = piece.model.read_text(encoding="latin-1")
    corners, uv, names = _triangles(text)
    if not len(corners):
        return None
    corners = corners @ np.array(piece.rotation).T
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    width, depth, height = piece.size_m
    scale = np.array([width, height, depth]) / np.maximum(high - low, 1e-6)
    corners = (corners - [(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2]) * scale
    corners = corners[..., [0, 2, 1]] * [1.0, -1.0, 1.0]  # y up, front at +z: z up, front at -y
    known = _materials(text, piece.model.parent)
    unique, index = np.unique(names, return_inverse=True)
    materials = [known.get(name, Material(np.full((1, 1, 3), 0.6, np.float32))) for name in unique]
    shown = np.array([material is not None for material in materials])[index]
    solid = tuple(material or Material(np.zeros((1, 1, 3), np.float32)) for material in materials)
    return Mesh(corners[shown], uv[shown], index[shown], solid) if shown.any() else None


def _triangles(text: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners ``(T, 3, 3)``, texture coordinates ``(T, 3, 2)`` and material names ``(T,)`` of an OBJ file."""
    points: list[list[float]] = []
    images: list[list[float]] = [[0.0, 0.0]]
    triangles: list[tuple[int, ...]] = []
    names: list[str] = []
    name = ""
    for line in text.replace("\\\n", " ").splitlines():
        word, _, rest = line.partition(" ")
        if word == "v":
            points.append([float(x) for x in rest.split()[:3]])
        elif word == "vt":
            u, v = [*rest.split(), "0"][:2]
            images.append([float(u), 1.0 - float(v)])
        elif word == "usemtl":
            name = rest.strip()
        elif word == "f":
            face = []
            for corner in rest.split():
                v, _, more = corner.partition("/")
                t = more.partition("/")[0]
                k, j = int(v), int(t) if t else 0
                face.append((k - 1 if k > 0 else len(points) + k, j if j >= 0 else len(images) + j))
            for second, third in itertools.pairwise(face[1:]):
                triangles.append((*face[0], *second, *third))
                names.append(name)
    if not triangles:
        return np.zeros((0, 3, 3)), np.zeros((0, 3, 2)), np.zeros(0, dtype=str)
    indices = np.array(triangles).reshape(-1, 3, 2)
    return np.array(points)[indices[..., 0]], np.array(images)[indices[..., 1]], np.array(names)


def _materials(text: str, folder: Path) -> dict[str, Material | None]:
    """Materials of the MTL files named by an OBJ file; None for transparent ones."""
    found: dict[str, Material | None] = {}
    for name in re.findall(r"^mtllib (.+?)\s*$", text, re.MULTILINE):
        file = folder / name
        if not file.is_file():
            continue
        for block in re.split(r"^newmtl ", file.read_text(encoding="latin-1"), flags=re.MULTILINE)[1:]:
            title, _, body = block.partition("\n")
            values = {w[0]: w[1:] for line in body.splitlines() if len(w := line.split()) > 1}
            if float(values.get("d", ["1"])[0]) < _GLASS_OPACITY:
                found[title.strip()] = None
                continue
            colour = np.array(values.get("Kd", ["0.6"] * 3)[:3], dtype=np.float32)
            image = _texture(file.parent / " ".join(values["map_Kd"])) if "map_Kd" in values else None
            plain = np.clip(colour, 0.02, 0.95).reshape(1, 1, 3)
            found[title.strip()] = Material(plain if image is None else image)
    return found


def _texture(path: Path) -> np.ndarray | None:
    data = cv2.imread(str(path), cv2.IMREAD_COLOR) if path.is_file() else None
    if data is None:
        return None
    shrink = min(1.0, _MAX_TEXTURE_PX / max(data.shape[:2]))
    data = cv2.resize(data, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA) if shrink < 1 else data
    return (data[:, :, ::-1] / 255.0).astype(np.float32)
