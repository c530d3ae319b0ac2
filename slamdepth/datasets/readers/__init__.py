# SPDX-License-Identifier: Apache-2.0
"""One file per sequence layout; every module in here is imported by the registry."""
