# SPDX-License-Identifier: Apache-2.0
"""How far below the horizon each part of a view lies: the form in which a depth head is given gravity."""

from __future__ import annotations

import torch
from torch import Tensor

from slamdepth.depth.head_layers import FACTOR


def gravity_field(gravity: Tensor, focal_px: Tensor, rows: int, columns: int) -> Tensor:
    """The gravity field of views with square pixels and a centred principal point.

    Args:
        gravity: ``(B, 3)`` unit direction of gravity in the camera's frame (x right, y down, z forward);
            all zeros where it is unknown, and the field is then zero too.
        focal_px: ``(B,)`` focal length in pixels of the view.
        rows, columns: of the view.

    Returns:
        ``(B, 4, rows / 7, columns / 7)``. The channels are ``s``, ``s * s``, ``|s|`` and 1, where ``s`` is
        the sine of the angle below the horizon of the ray through the centre of each 7 x 7 block.
    """
    y = (torch.arange(rows // FACTOR, device=gravity.device) + 0.5) * FACTOR - rows / 2
    x = (torch.arange(columns // FACTOR, device=gravity.device) + 0.5) * FACTOR - columns / 2
    x, y, f = x[None, None, :], y[None, :, None], focal_px[:, None, None]
    gx, gy, gz = gravity[:, :, None, None].unbind(dim=1)
    s = (gx * x + gy * y + gz * f) / (x * x + y * y + f * f).sqrt()
    is_known = (gravity != 0).any(dim=1)[:, None, None, None]
    return torch.stack([s, s * s, s.abs(), torch.ones_like(s)], dim=1) * is_known
