# SPDX-License-Identifier: Apache-2.0
"""One export format a file; :mod:`slamdepth.export.registry` imports them all."""
