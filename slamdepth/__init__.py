# SPDX-License-Identifier: Apache-2.0
"""slamdepth: one camera in, a metric trajectory and a mesh out."""
