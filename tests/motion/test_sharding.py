"""Claims about sharding: an ensemble on eight devices gives what one device gives."""

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

SCALING = Path(__file__).parents[2] / "SCALING.md"
#: Sums in another order, relative to the largest value.
ROUNDING = 1e-12
SAVE = """
leaves = jax.tree.leaves((values, gradients))
np.savez(sys.argv[1], *leaves, devices=len(values.sharding.device_set), status=status)
"""


def example():
    """The program in SCALING.md: its first block of Python code"""
    return re.findall(r"```python\n(.*?)```", SCALING.read_text(), re.DOTALL)[0]


def run_example(path, n_devices):
    flags = f"--xla_force_host_platform_device_count={n_devices}"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    subprocess.run(
        [sys.executable, "-c", "import sys\n" + example() + SAVE, str(path)],
        env=environment,
        check=True,
    )
    return np.load(path)


@pytest.mark.slow
def test_sharded_ensemble_equals_the_single_device(tmp_path):
    many = run_example(tmp_path / "many.npz", 8)
    one = run_example(tmp_path / "one.npz", 1)
    assert (many["devices"], one["devices"]) == (8, 1)
    np.testing.assert_array_equal(one["status"], 0)
    np.testing.assert_array_equal(many["status"], one["status"])
    results = [name for name in one.files if name.startswith("arr_")]
    assert len(results) == 6  # the value and five gradients
    for name in results:
        size = np.max(np.abs(one[name]))
        assert size > 0.0
        np.testing.assert_allclose(many[name], one[name], atol=ROUNDING * size)
