# SPDX-License-Identifier: Apache-2.0
"""Addresses of live sources: which texts are some, and how they are shown."""

from __future__ import annotations

import re

# A pathlib.Path makes one of the two slashes.
_ADDRESS = re.compile(r"(rtsps?|rtmp|https?):/{1,2}(.+)", re.IGNORECASE | re.DOTALL)
_USER = re.compile(r"^[^/@]*@")
_QUERY = re.compile(r"\?.*", re.DOTALL)


def is_address(text: str) -> bool:
    """True for an address of RTSP, RTMP, HTTP or HTTPS."""
    return _ADDRESS.fullmatch(text) is not None


def address_of(text: str) -> str:
    """An address with both its slashes."""
    found = _ADDRESS.fullmatch(text)
    return text if found is None else f"{found[1]}://{found[2]}"


def without_secret(text: str) -> str:
    """An address without user, password and query, for messages and reports; any other text as it is."""
    found = _ADDRESS.fullmatch(text)
    return text if found is None else f"{found[1]}://{_QUERY.sub('', _USER.sub('', found[2]))}"
