# SPDX-License-Identifier: Apache-2.0
"""Readers of training data, one file per layout; see :mod:`slamdepth.training.data`."""
