# SPDX-License-Identifier: Apache-2.0
"""Calibration of a camera by images of a flat board."""
