# SPDX-License-Identifier: Apache-2.0
"""Dense depth of keyframes from many views.

A keyframe's predicted depth is right in its coarse relief and wrong in detail. Frames that see the same
surface from elsewhere tell where it is: depths about the prediction are compared by how well the images
agree (plane sweep, Collins 1996, with the prediction in place of planes), smoothed by semi-global matching
(Hirschmueller 2008), kept where other keyframes find the same surface, and completed by the prediction.
"""

from slamdepth.dense.reconstruct import EFFORTS, DenseEffort, densify

__all__ = ["EFFORTS", "DenseEffort", "densify"]
