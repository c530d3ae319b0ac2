# SPDX-License-Identifier: Apache-2.0
"""Recognising places, closing loops, and checking loops for consistency."""
