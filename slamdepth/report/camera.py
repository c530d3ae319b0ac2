# SPDX-License-Identifier: Apache-2.0
"""What a report says about the camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from slamdepth.datasets.intrinsics import CameraSource, Certainty
from slamdepth.types import Camera

NOT_OBSERVABLE = "the motion does not show it: give --fov or --camera"


@dataclass(frozen=True)
class CameraFacts:
    """The camera of a run, and how it is known.

    Attributes:
        tracked: the camera that the run used, of the images as they were tracked.
        source: where its first guess comes from.
        found: the same as the final map shows it; None where the camera was given or could not be looked for.
        sigma_log_f: deviation of the logarithm of the focal length; None where the camera was given.
        sigma_k1: deviation of the first radial coefficient; None where it was not looked for.
        is_observed: whether the motion shows the focal length.
    """

    tracked: Camera
    source: CameraSource
    found: Camera | None = None
    sigma_log_f: float | None = None
    sigma_k1: float | None = None
    is_observed: bool = False

    @property
    def is_given(self) -> bool:
        return self.source.certainty is Certainty.GIVEN

    @property
    def best(self) -> Camera:
        """The camera that is reported."""
        return self.found if self.found is not None and self.is_observed else self.tracked

    @property
    def source_text(self) -> str:
        """Where the intrinsics come from, in a few words."""
        if self.is_given:
            return self.source.how
        if self.is_observed:
            return f"found from the motion; at first {self.source.how}"
        if self.source.certainty is Certainty.NOMINAL:
            return f"{self.source.how}; the motion shows it no better"
        return f"{self.source.how}; {NOT_OBSERVABLE}"

    @property
    def is_a_guess(self) -> bool:
        """Whether nothing but a guess tells the focal length."""
        return self.source.certainty is Certainty.GUESSED and not self.is_observed

    @property
    def sentence(self) -> str:
        """The camera in one line."""
        camera = self.best
        text = f"f {camera.fx:.1f} px"
        if camera.fy != camera.fx:
            text = f"fx {camera.fx:.1f}, fy {camera.fy:.1f} px"
        if self.sigma_log_f is not None:
            text += f" ± {100 * self.sigma_log_f:.2g} %"
        return f"{text} at {camera.width}x{camera.height}, {self.source_text}"

    def to_dict(self) -> dict[str, Any]:
        """The content of ``camera`` in ``report.json``."""
        camera, sigma = self.best, self.sigma_log_f
        return {
            **_figures(camera),
            "source": self.source_text,
            "certainty": self.source.certainty.value,
            "observed": None if self.is_given else self.is_observed,
            "sigma": None if sigma is None else {
                "fx": sigma * camera.fx,
                "fy": sigma * camera.fy,
                "relative": sigma,
                "k1": self.sigma_k1,
            },
            "tracked_with": _figures(self.tracked),
            "sentence": self.sentence,
        }  # fmt: skip


def _figures(camera: Camera) -> dict[str, Any]:
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "distortion": list(camera.distortion),
    }
