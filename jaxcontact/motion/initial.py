"""The unknowns that a motion starts from."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import Bound, SemismoothNewton, WeakContact, contact_problem
from jaxcontact.linear.dense import DenseFactor
from jaxcontact.schemes.terms import gap_resolution
from jaxcontact.system.sparse import SymmetricMatrix
from jaxcontact.system.system import System


def first_displacement(
    system: System, displacement: Array, weak_contact: WeakContact | None
) -> Array:
    """Return the unknowns (n,) of an admissible nodal field (N, d) [m].

    In a reduced model the nearest admissible ones: the M-orthogonal projection of an admissible
    field may penetrate, its projection on {q: N q <= psi} does not. Both in one contact problem,
    whose matrix is the mass, the identity.
    """
    y = system.restrict(displacement)
    if system.basis is None or system.normals.count == 0:
        return y
    normals, identity = system.normals, jnp.eye(system.size, dtype=y.dtype)
    rows = jax.lax.stop_gradient(normals.weights)
    factor = DenseFactor(identity, rows, rows @ rows.T)
    nearest = replace(
        contact_problem(SymmetricMatrix(identity, None), normals, factor, SemismoothNewton()),
        weak_contact=weak_contact,
    )
    bound = Bound(system.gap, gap_resolution(system, y))
    return nearest.solve(y, bound, nearest.form.first_guess())[0]
