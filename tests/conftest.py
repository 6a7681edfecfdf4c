"""Settings of all tests."""

import os
import subprocess
import sys
import tempfile

# What one process has compiled, the others of this run load, since most of the time is
# compilation. The folder is made anew for every run: no program of an older version is ever met.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    _programs = tempfile.TemporaryDirectory(prefix="jaxcontact-tests-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _programs.name
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0"

import hypothesis
import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
# Random cases are the same in every run: a failure is one of the code.
hypothesis.settings.register_profile("fixed", derandomize=True, deadline=None)
hypothesis.settings.load_profile("fixed")

#: A quarter of the time to compile, for slower machine code of the same operations. The longer
#: pass runs what users run, and so does the fast one with an empty XLA_FLAGS.
QUICK_COMPILATION = (
    "--xla_backend_optimization_level=0 --xla_cpu_use_fusion_emitters=false "
    "--xla_cpu_parallel_codegen_split_count=1"
)


def pytest_configure(config):
    if config.option.markexpr == "not slow" and "XLA_FLAGS" not in os.environ:
        os.environ["XLA_FLAGS"] = QUICK_COMPILATION
        # An unknown flag ends the process, and only a new one tells: JAX reads them once.
        check = [sys.executable, "-c", "import jax; assert jax.default_backend() == 'cpu'"]
        if subprocess.run(check, capture_output=True, check=False).returncode:
            del os.environ["XLA_FLAGS"]


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    # Thousands of live programs exhaust the memory maps of a process, and the compiler crashes.
    yield
    jax.clear_caches()
