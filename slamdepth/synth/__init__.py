# SPDX-License-Identifier: Apache-2.0
"""The renderer: furnished rooms with exact depth and poses."""
