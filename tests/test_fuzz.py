# SPDX-License-Identifier: Apache-2.0
"""Damaged input ends in an error of one line or a sound result; ``make fuzz`` runs many more cases."""

from __future__ import annotations

from pathlib import Path

import fuzz
import pytest
from fuzz_targets import targets

CASES = 12
TARGETS = {target.name: target for target in targets(slow=False)}


@pytest.mark.parametrize("name", TARGETS)
def test_damaged_input_ends_in_one_line_or_a_sound_result(name: str, tmp_path: Path) -> None:
    good = tmp_path / "good"
    good.mkdir()
    path = TARGETS[name].make(good)
    for number in range(CASES):
        fuzz.run_case(TARGETS[name], number, 1, (good, path), tmp_path / str(number))


@pytest.mark.parametrize("name", TARGETS)
def test_undamaged_input_is_read(name: str, tmp_path: Path) -> None:
    TARGETS[name].read(TARGETS[name].make(tmp_path))
