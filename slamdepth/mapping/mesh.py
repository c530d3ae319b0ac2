# SPDX-License-Identifier: Apache-2.0
"""Coloured triangle meshes, and their files."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import OutputError
from slamdepth.geometry import rotation_to_quat_xyzw
from slamdepth.io import encode_ply, replacing

if TYPE_CHECKING:
    from numpy.typing import NDArray


@dataclass(frozen=True)
class Mesh:
    """A mesh in the world frame.

    Attributes:
        vertices_m: ``(V, 3)`` float32 metres of the map.
        triangles: ``(T, 3)`` int32 vertex numbers, counter-clockwise seen from outside.
        colors: ``(V, 3)`` float32 sRGB, 0 to 1.
        notes: what was limited or left out when it was made, one line each.
    """

    vertices_m: NDArray[np.float32]
    triangles: NDArray[np.int32]
    colors: NDArray[np.float32]
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        count = len(self.vertices_m)
        if self.vertices_m.shape != (count, 3) or self.colors.shape != (count, 3):
            raise ValueError(
                f"a mesh needs (V, 3) vertices and colours, got {self.vertices_m.shape}, {self.colors.shape}"
            )
        if self.triangles.shape != (len(self.triangles), 3):
            raise ValueError(f"a mesh needs (T, 3) triangles, got {self.triangles.shape}")
        if len(self.triangles) and not 0 <= self.triangles.min() <= self.triangles.max() < count:
            raise ValueError(f"a triangle names a vertex outside 0 to {count - 1}")

    @classmethod
    def empty(cls, *notes: str) -> Mesh:
        """A mesh without vertices."""
        none = np.zeros((0, 3), np.float32)
        return cls(none, np.zeros((0, 3), np.int32), none, notes)

    def normals(self) -> NDArray[np.float32]:
        """Unit normals ``(V, 3)`` of the vertices: those of the triangles at them, weighted by area.

        They point outside; zero where no triangle has an area.
        """
        corners = self.vertices_m[self.triangles].astype(np.float64)
        faces = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        count = len(self.vertices_m)
        found = np.zeros((count, 3))
        for axis in range(3):
            for corner in self.triangles.T:
                found[:, axis] += np.bincount(corner, faces[:, axis], count)
        length = np.linalg.norm(found, axis=1, keepdims=True)
        return np.asarray(np.divide(found, length, out=found, where=length > 0), np.float32)

    def save(self, path: str | Path, *, T_viewer_world: NDArray[np.float64] | None = None) -> None:
        """Write the mesh as binary PLY, OBJ or GLB, by the ending of ``path``.

        The file is written whole or not at all. PLY and OBJ keep the world frame (y down when the first
        camera is level). GLB viewers expect y up, so its scene node turns the mesh.
        PLY has unit normals too, see :meth:`normals`. OBJ has the colours after the positions, as MeshLab
        and Open3D read them.

        Args:
            T_viewer_world: ``(4, 4)`` rotation of GLB's scene node. Default: 180 degrees about x, which is
                right where the first camera was level.

        Raises:
            OutputError: the ending is none of these, or ``path`` cannot be written.
        """
        path = Path(path)
        encode = _ENCODERS.get(path.suffix.lower())
        if encode is None:
            raise OutputError(f"{path}: a mesh file must end in one of {', '.join(_ENCODERS)}")
        quat_xyzw = (1.0, 0.0, 0.0, 0.0)
        if T_viewer_world is not None:
            quat_xyzw = tuple(rotation_to_quat_xyzw(T_viewer_world[:3, :3]).tolist())
        data = encode(self, quat_xyzw)
        with replacing(path) as temporary:
            temporary.write_bytes(data)


def _bytes_of(colors: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.round(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)


_Quaternion = tuple[float, ...]


def _ply(mesh: Mesh, _: _Quaternion) -> bytes:
    return encode_ply(mesh.vertices_m, _bytes_of(mesh.colors), mesh.triangles, normals=mesh.normals())


def _obj(mesh: Mesh, _: _Quaternion) -> bytes:
    colors = _bytes_of(mesh.colors) / 255.0
    lines = ["# vertices: x y z r g b"]
    lines += [
        f"v {x:.6g} {y:.6g} {z:.6g} {r:.4f} {g:.4f} {b:.4f}"
        for x, y, z, r, g, b in np.hstack([mesh.vertices_m, colors]).tolist()
    ]
    lines += [f"f {a} {b} {c}" for a, b, c in (mesh.triangles + 1).tolist()]
    return ("\n".join(lines) + "\n").encode("ascii")


def _glb(mesh: Mesh, quat_xyzw: _Quaternion) -> bytes:
    """Binary glTF 2.0: one primitive with vertex colours, shown unlit, turned by its node."""
    document: dict[str, Any] = {"asset": {"version": "2.0", "generator": "slamdepth"}, "scene": 0}
    binary = b""
    if len(mesh.triangles) == 0:
        document["scenes"] = [{"nodes": []}]  # glTF knows no empty mesh
    else:
        # glTF's colours are linear; 16 bits, or dark shades would merge.
        srgb = np.clip(mesh.colors.astype(np.float64), 0.0, 1.0)
        linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
        rgba = np.full((len(srgb), 4), 65535, "<u2")
        rgba[:, :3] = np.round(linear * 65535.0)
        parts = [
            mesh.vertices_m.astype("<f4").tobytes(),
            rgba.tobytes(),
            mesh.triangles.astype("<u4").tobytes(),
        ]
        binary = b"".join(parts)
        starts = [0, len(parts[0]), len(parts[0]) + len(parts[1])]
        array_buffer, element_array_buffer = 34962, 34963
        float_, unsigned_short, unsigned_int = 5126, 5123, 5125
        document |= {
            "extensionsUsed": ["KHR_materials_unlit"],
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "rotation": list(quat_xyzw)}],
            "meshes": [
                {"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "indices": 2, "material": 0}]}
            ],
            "materials": [
                {
                    "doubleSided": True,
                    "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 1.0},
                    "extensions": {"KHR_materials_unlit": {}},
                }
            ],
            "buffers": [{"byteLength": len(binary)}],
            "bufferViews": [
                {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": target}
                for start, part, target in zip(
                    starts, parts, (array_buffer, array_buffer, element_array_buffer), strict=True
                )
            ],
            "accessors": [
                {
                    "bufferView": 0, "componentType": float_, "count": len(srgb), "type": "VEC3",
                    "min": mesh.vertices_m.min(axis=0).tolist(), "max": mesh.vertices_m.max(axis=0).tolist(),
                },
                {
                    "bufferView": 1, "componentType": unsigned_short, "normalized": True,
                    "count": len(srgb), "type": "VEC4",
                },
                {
                    "bufferView": 2, "componentType": unsigned_int,
                    "count": 3 * len(mesh.triangles), "type": "SCALAR",
                },
            ],
        }  # fmt: skip
    text = json.dumps(document, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if binary:
        chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


_ENCODERS = {".ply": _ply, ".obj": _obj, ".glb": _glb}
