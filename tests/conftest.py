import jax
import pytest

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")


@pytest.fixture(autouse=True, scope="module")
def _forget_compiled_programs():
    # Thousands of live programs exhaust the memory maps of a process, and the compiler crashes.
    yield
    jax.clear_caches()
