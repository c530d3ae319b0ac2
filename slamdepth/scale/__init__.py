# SPDX-License-Identifier: Apache-2.0
"""What the lengths of a finished map should be multiplied by, from several kinds of evidence."""
