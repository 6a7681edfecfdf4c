"""Which linear solver a system gets when the user names none, and whether its factor fits.

Measured: the dense inverse is no slower up to some 150 unknowns, nested dissection wins beyond, and
conjugate gradients are for factors that do not fit in memory.
"""

from __future__ import annotations

from jaxcontact.linear.conjugate_gradient import ConjugateGradient
from jaxcontact.linear.dense import Dense
from jaxcontact.linear.dissection.nested_dissection import NestedDissection
from jaxcontact.linear.interface import LinearSolver
from jaxcontact.linear.memory import available_memory

#: Largest number of unknowns that are solved by the dense inverse.
DENSE_LIMIT = 150

#: Largest factor that is chosen without asking, [bytes].
FACTOR_LIMIT = 2 * 2**30


def choose_linear_solver(
    size: int, dimension: int, itemsize: int, *, is_dense: bool = False
) -> LinearSolver:
    """Return the solver for n = `size` unknowns in a space of dimension d.

    Args:
        size: number of unknowns.
        dimension: space dimension.
        itemsize: bytes per number.
        is_dense: the matrices are dense (a reduced model).
    """
    if is_dense or size <= DENSE_LIMIT:
        return Dense()
    dissection = NestedDissection()
    is_small = dissection.bytes_needed(size, dimension, itemsize) <= FACTOR_LIMIT
    return dissection if is_small else ConjugateGradient()


def check_memory(solver: LinearSolver, size: int, dimension: int, itemsize: int) -> None:
    """Check that a factor fits in the memory of the machine, as far as that is known.

    Raises:
        ValueError: if the estimated factor is larger than the available memory.
    """
    needed = solver.bytes_needed(size, dimension, itemsize)
    available = available_memory()
    if available is not None and needed > available:
        raise ValueError(
            f"the factor of {type(solver).__name__} for {size} unknowns needs about "
            f"{needed / 2**30:.1f} GiB, {available / 2**30:.1f} GiB are free; use "
            "linear_solver=jc.ConjugateGradient(), a coarser mesh or float32"
        )
