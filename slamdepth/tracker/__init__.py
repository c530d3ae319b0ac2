# SPDX-License-Identifier: Apache-2.0
"""Composition of front end, back end and map into one tracker."""

from slamdepth.tracker.tracker import Tracker

__all__ = ["Tracker"]
