# SPDX-License-Identifier: Apache-2.0
"""Training of depth heads on frozen, cached backbone features."""
