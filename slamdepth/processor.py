# SPDX-License-Identifier: Apache-2.0
"""The vector instructions that torch uses here: those of the processor, less what two variables forbid.

``ATEN_CPU_CAPABILITY`` limits PyTorch's own kernels and ``ONEDNN_MAX_CPU_ISA`` those of oneDNN, which
multiplies matrices. A processor of another kind can be tried with both.
"""

from __future__ import annotations

import os

_KNOWN = ("avx2", "avx512_f", "avx512_bf16", "amx_bf16")
_BFLOAT16 = ("avx512_bf16", "amx_bf16")
_UNLIMITED = ("", "ALL", "DEFAULT")


def instructions() -> tuple[str, ...]:
    """Those of AVX2, AVX-512, and bfloat16 by AVX-512 or AMX, that are used; empty where torch is too old.

    They decide how fast a network is.
    """
    import torch

    if not hasattr(torch.cpu, "get_capabilities"):
        return ()
    has = torch.cpu.get_capabilities()
    limit = os.environ.get("ONEDNN_MAX_CPU_ISA", "").upper()
    is_wide = torch.backends.cpu.get_cpu_capability().upper().startswith("AVX512")
    is_wide = is_wide and (limit in _UNLIMITED or limit.startswith(("AVX512", "AVX10")))
    has_bfloat16 = is_wide and (limit in _UNLIMITED or any(name in limit for name in ("BF16", "FP16", "AMX")))
    allowed = {"avx2": True, "avx512_f": is_wide, **dict.fromkeys(_BFLOAT16, has_bfloat16)}
    return tuple(name for name in _KNOWN if has.get(name) and allowed[name])


def has_bfloat16() -> bool:
    """Whether products of bfloat16 are native, and so about twice as fast as those of float32.

    Elsewhere they are emulated, and five times slower.
    """
    return any(name in _BFLOAT16 for name in instructions())
