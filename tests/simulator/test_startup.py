"""A quick start leaves numba as it would be otherwise."""

import subprocess
import sys

CODE = """
import sys
from rapid.simulator import make_env
env = make_env("lane-3-density-2-fast")
env.reset(seed=0)
env.step(1)
print("scipy.linalg" in sys.modules)
import numba, numpy as np
import numba.np.linalg
print(numba.np.linalg.ensure_blas.__name__)
print(numba.njit(lambda a, b: a @ b)(np.eye(2), np.full((2, 2), 3.0)).sum())
"""


def test_scipy_is_not_imported_for_a_step_and_numba_still_multiplies_matrices() -> None:
    ran = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, timeout=300)
    assert ran.stdout.split() == ["False", "ensure_blas", "12.0"], ran.stderr
