"""Parameters for tests that compute points in several ways.

Compiling a kernel takes seconds of processor time, so in the quick tier only `test_numba_kernels`
compiles kernels. All other tests use kernels only in `make test-all`.
"""

from __future__ import annotations

from importlib.util import find_spec

import pytest

NO_NUMBA = "the fused back end needs Numba: pip install 'lidarspec[jit]'"
COMPILED = pytest.mark.skipif(find_spec("numba") is None, reason=NO_NUMBA)
KERNELS = pytest.param("jit", marks=[COMPILED, pytest.mark.slow])

#: plans and kernels, which are compared with the reference evaluator.
BACKENDS = pytest.mark.parametrize("backend", ["numpy", KERNELS])
#: those, and the reference evaluator itself.
EVERY_BACKEND = pytest.mark.parametrize("backend", ["construct", "numpy", KERNELS])
