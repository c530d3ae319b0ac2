# SPDX-License-Identifier: Apache-2.0
"""Benchmarks: run from a checkout, not part of the package."""
