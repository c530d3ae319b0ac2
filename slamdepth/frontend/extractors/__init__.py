# SPDX-License-Identifier: Apache-2.0
"""One file per feature; every module in here is imported by the registry."""
