# SPDX-License-Identifier: Apache-2.0
"""A video, or any other sequence, to a mesh.

python docs/examples/video_to_mesh.py walk.mp4 walk.glb --camera phone.yaml
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import slamdepth


def video_to_mesh(dataset: slamdepth.Dataset, depth: str, mesh_path: Path) -> str:
    """Track ``dataset``, fuse its keyframes, write the mesh, and describe the result in one line."""
    model = slamdepth.create_depth_model(depth)
    with slamdepth.Tracker(dataset.camera, depth_model=model) as tracker:
        for frame in dataset:
            result = tracker.step(frame)
            print(f"{result.timestamp_s:.3f} s: {result.status.value}")
        reconstruction = tracker.finish()
    reconstruction = slamdepth.densify(reconstruction, dataset)
    mesh = reconstruction.fuse_mesh(voxel_size_m=0.02)
    mesh.save(mesh_path)
    return f"{mesh_path}: from {len(reconstruction.keyframes)} keyframes of {len(dataset)} frames"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program."""
    parser = argparse.ArgumentParser(description="A video, or any other sequence, to a mesh.")
    parser.add_argument("sequence", type=Path, help="video, folder of images, TUM or 7-Scenes folder")
    parser.add_argument("mesh", type=Path, help="file to write: .ply, .obj or .glb")
    parser.add_argument("--camera", type=Path, help="camera.yaml; needed for a video")
    parser.add_argument("--depth", default="dinov2", help="depth model, or 'sensor' (default: dinov2)")
    options = parser.parse_args(arguments)
    try:
        dataset = slamdepth.open_dataset(options.sequence, options.camera)
        print(video_to_mesh(dataset, options.depth, options.mesh))
    except slamdepth.SlamdepthError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
