# SPDX-License-Identifier: Apache-2.0
"""Which vector instructions count as used."""

from __future__ import annotations

import pytest
import torch

from slamdepth.processor import has_bfloat16, instructions

_ALL = {"avx2": True, "avx512_f": True, "avx512_bf16": True, "amx_bf16": False}


def _processor(monkeypatch: pytest.MonkeyPatch, has: dict[str, bool], kernels: str, onednn: str) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: has, raising=False)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: kernels)
    monkeypatch.setenv("ONEDNN_MAX_CPU_ISA", onednn)


@pytest.mark.parametrize("onednn", ["", "ALL", "AVX512_CORE_BF16", "avx10_1_512_amx"])
def test_native_bfloat16_is_used_where_nothing_forbids_it(
    monkeypatch: pytest.MonkeyPatch, onednn: str
) -> None:
    _processor(monkeypatch, _ALL, "AVX512", onednn)
    assert instructions() == ("avx2", "avx512_f", "avx512_bf16")
    assert has_bfloat16()


@pytest.mark.parametrize(
    ("kernels", "onednn", "left"),
    [
        ("AVX2", "", ("avx2",)),
        ("AVX512", "AVX2", ("avx2",)),
        ("AVX2", "AVX2", ("avx2",)),
        ("AVX512", "AVX512_CORE_VNNI", ("avx2", "avx512_f")),
    ],
)
def test_a_limit_on_instructions_switches_bfloat16_off(
    monkeypatch: pytest.MonkeyPatch, kernels: str, onednn: str, left: tuple[str, ...]
) -> None:
    _processor(monkeypatch, _ALL, kernels, onednn)
    assert instructions() == left
    assert not has_bfloat16()


def test_a_processor_without_bfloat16_does_not_use_it(monkeypatch: pytest.MonkeyPatch) -> None:
    _processor(monkeypatch, {"avx2": True, "avx512_f": True}, "AVX512", "")
    assert not has_bfloat16()
