# SPDX-License-Identifier: Apache-2.0
"""Every error slamdepth raises on purpose.

    SlamdepthError
    ├── InputError            what the user handed in is wrong (exit code 2)
    │   ├── DatasetError      a sequence folder, list file or ground truth
    │   ├── CameraError       intrinsics missing or contradicting the images
    │   ├── ConfigError       an unknown or out-of-range setting
    │   └── OutputError       an output place that cannot be written
    ├── ImageDecodeError      one image that does not decode (the run skips it)
    ├── SourceEnded           a live source ended or stalled (the run is finished with what it has)
    ├── WeightsError          network weights missing, damaged or of another layout
    └── TrackingError         the tracker was used against its contract

The command line prints ``str(error)`` as its one line, so each message says what is
wrong, where, and what to do.
"""

from __future__ import annotations


class SlamdepthError(Exception):
    """Base of all errors raised on purpose; ``exit_code`` is the process's exit code."""

    exit_code = 1


class InputError(SlamdepthError):
    """What the user handed in is wrong."""

    exit_code = 2


class DatasetError(InputError):
    """A sequence folder, a list file or a ground truth is missing or malformed."""


class CameraError(InputError):
    """Intrinsics are missing, malformed or contradict the images."""


class ConfigError(InputError):
    """A setting is unknown or out of range."""


class OutputError(InputError):
    """An output place cannot be written."""


class ImageDecodeError(SlamdepthError):
    """One image does not decode; a run skips it and counts it."""


class SourceEnded(SlamdepthError):
    """A live source gives no more frames; a run is finished with those it has."""


class WeightsError(SlamdepthError):
    """Network weights are missing, damaged or of another layout."""

    exit_code = 2


class TrackingError(SlamdepthError):
    """The tracker was used against its contract."""
