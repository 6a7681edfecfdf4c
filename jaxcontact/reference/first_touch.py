"""Energy that the contact-implicit scheme loses when a bar touches a wall.

A free P1 bar of n equal cells flies against a wall with v0 (`FreeBar`), dt = nu h/c, and its
contact node reaches the wall at the fraction theta of a step. The contact impulse Lam of that step
stops the node there, (1 - theta) v0 = Lam/(2 X), where 1/X is the contact entry of the inverse of
D = M + dt^2/4 A, and the energy lost is Lam theta v0. For a semi-infinite bar, with 2 alpha (at the
contact node alpha) on the diagonal of D and beta beside it, X^2 = alpha^2 - beta^2. Relative to
E0 = rho L v0^2/2 this is

    4 theta (1 - theta)/n * sqrt((1 + 3 nu^2)/12)    consistent mass,
    4 theta (1 - theta)/n * sqrt(1 + nu^2)/2         lumped mass.

Source: derived here for the scheme of Kane, Repetto, Ortiz, Marsden, CMAME 180 (1999).
"""

import jax.numpy as jnp
from jax import Array
from jax.typing import ArrayLike


def first_touch_loss(
    theta: ArrayLike, courant: ArrayLike, n_cells: ArrayLike, *, lumped: bool = False
) -> Array:
    """Return the relative energy loss of the first touching step of the contact-implicit scheme.

    It is exact while n_cells is large against courant, so that the bar acts as semi-infinite.
    For theta = 1/2 the later steps lose nothing, so that the whole impact loses exactly this.

    Args:
        theta: part of the step that passes before the touch, in [0, 1], any shape or ().
        courant: Courant number nu = c dt/h > 0, the same shape or ().
        n_cells: number n = L/h of cells, the same shape or ().
        lumped: whether the mass matrix is lumped (row sums) instead of consistent.

    Returns:
        (E0 - E)/E0 >= 0, the common shape [-].
    """
    theta, courant, n_cells = jnp.broadcast_arrays(theta, courant, n_cells)
    root = jnp.sqrt(1 + courant**2) / 2 if lumped else jnp.sqrt((1 + 3 * courant**2) / 12)
    return 4 * theta * (1 - theta) / n_cells * root
