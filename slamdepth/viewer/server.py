# SPDX-License-Identifier: Apache-2.0
"""The web server of a viewer."""

from __future__ import annotations

import io
import logging
import socket
from contextlib import redirect_stdout
from typing import TYPE_CHECKING, Any

import numpy as np

from slamdepth.errors import ConfigError, SlamdepthError
from slamdepth.geometry import rotation_to_quat_xyzw

if TYPE_CHECKING:
    from slamdepth.typing import Floats

HOST, PORT = "127.0.0.1", 8080

PATH, NOW, LOOP, TRUTH = (23, 105, 212), (217, 119, 6), (47, 158, 97), (120, 130, 145)
"""Colours of the path, of the camera that is shown, of loops and of the ground truth."""


def start_server(host: str = HOST, port: int = PORT) -> Any:
    """A ``viser.ViserServer``; only this machine reaches it unless ``host`` is another address.

    Args:
        port: 0 takes a free one.

    Raises:
        SlamdepthError: viser is not installed.
        ConfigError: the address or port cannot be had.
    """
    try:
        import viser
    except ImportError as error:
        raise SlamdepthError(
            "the viewer needs viser, which is not installed: pip install 'slamdepth[viewer]'"
        ) from error
    if not 0 <= port <= 65535:
        raise ConfigError(f"the port must be 0 to 65535, got {port}")
    logging.getLogger("websockets").setLevel(logging.ERROR)  # browsers that leave are no news
    try:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
            port = probe.getsockname()[1]
    except OSError as error:
        raise ConfigError(
            f"{host}:{port} cannot be opened ({error.strerror or error}); name another --port, 0 for any"
        ) from error
    with redirect_stdout(io.StringIO()):  # viser prints an address of its own
        server = viser.ViserServer(host=host, port=port, label="slamdepth", verbose=False)
    server.gui.configure_theme(show_logo=False, show_share_button=False)
    return server


def stop_server(server: Any) -> None:
    """End a server and its threads."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address_of(server: Any) -> str:
    """The URL that a browser opens."""
    host = server.get_host()
    if host in ("0.0.0.0", "::"):
        host = socket.gethostname()
    return f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"


def placed(T_world_camera: Floats) -> dict[str, Floats]:
    """A pose as viser takes it: ``wxyz`` and ``position``."""
    return {
        "wxyz": np.roll(rotation_to_quat_xyzw(T_world_camera[:3, :3]), 1),
        "position": np.asarray(T_world_camera[:3, 3]),
    }


def frustum_lines(T_world_camera: Floats, aspect: tuple[float, float], depth: float) -> Floats:
    """The edges ``(K * 8, 2, 3)`` of the frustums of cameras ``(K, 4, 4)``, ``depth`` metres deep.

    Args:
        aspect: half the width and half the height of an image at a distance of 1.
    """
    x, y = aspect
    corners = np.array([[-x, -y, 1], [x, -y, 1], [x, y, 1], [-x, y, 1]]) * depth
    at = np.einsum("kij,cj->kci", T_world_camera[:, :3, :3], corners) + T_world_camera[:, None, :3, 3]
    eyes = np.broadcast_to(T_world_camera[:, None, :3, 3], at.shape)
    rays, rim = np.stack([eyes, at], axis=2), np.stack([at, np.roll(at, -1, axis=1)], axis=2)
    return np.concatenate([rays, rim], axis=1).reshape(-1, 2, 3)


def field_of_view(aspect: tuple[float, float]) -> dict[str, float]:
    """The images of the camera as viser's frustums take them."""
    return {"fov": float(2 * np.arctan(aspect[1])), "aspect": aspect[0] / aspect[1]}
