# SPDX-License-Identifier: Apache-2.0
"""What a frame that was placed counts as."""

from __future__ import annotations

from slamdepth.mapping.placement import PlacedBy
from slamdepth.types import TrackingStatus

STATUS = {
    PlacedBy.MOTION: TrackingStatus.TRACKING,
    PlacedBy.LAST_KEYFRAME: TrackingStatus.TRACKING,
    PlacedBy.PLACE: TrackingStatus.RELOCALISED,
    PlacedBy.REGISTRATION: TrackingStatus.REGISTERED,
}
"""The status of a frame by what it was placed by."""
