"""The one place where numba's flags are chosen."""

from __future__ import annotations

from typing import Any

# No fastmath: it lets NaN disappear and reorders the sums that tests compare.
JIT: dict[str, Any] = {'cache': True, 'nogil': True}

# Kernels made for SIMD: a division by zero gives inf or NaN instead of an
# exception, whose test would keep the loop scalar.
KERNEL_JIT: dict[str, Any] = {**JIT, 'error_model': 'numpy'}
