"""Relaxed contact: p_i g_i = kappa instead of p_i g_i = 0, a smooth model of the contact law.

    g = W p + q,    p_i g_i = kappa > 0,    p, g > 0,

are the optimality conditions of the strictly convex barrier problem

    min  1/2 p.W p + q.p - kappa sum_i log p_i.

In the unknown x = d p - g with d = diag W of `smooth_law.py` the law is

    r = sqrt(x^2 + 4 d kappa),    p = (r + x) / (2 d),    g = (r - x) / 2,

never infeasible, and Newton's method becomes the primal-dual active set method as kappa tends to
zero. The derivative dp = -(W + diag(g / p))^-1 dq replaces the active set of exact contact by the
weight g / p: zero on strong contact, infinite off contact, and in weak contact the share of the
multiplier. Source: MATH.md 5; Forsgren, Gill, Wright, SIAM Review 44 (2002) for the barrier; Chen,
Harker, SIAM J. Matrix Anal. Appl. 14 (1993) for the unknown x.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import jax
import jax.numpy as jnp
from jax import Array

from jaxcontact.contact import smooth_law
from jaxcontact.contact.closing_speed import PreparedScene, StartingState, closing_speed
from jaxcontact.contact.complementarity import Guess, Solution
from jaxcontact.contact.smooth_law import PairState
from jaxcontact.transforms.traced import poison_unless

#: kappa of `for_scene` in units of speed^2 times the mass that a pair has within a step. Less keeps
#: some of the dependence on the phase of the touch, more is too soft.
FRACTION = 0.05


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RelaxedContact:
    """Smooth contact with the law (multiplier) x (separation velocity) = kappa.

    Every pair feels every obstacle at any distance, so gradients exist everywhere, do not vanish
    before touch, and have derivatives of every order: the law for homotopies and for starts that
    do not touch. A pair never touches. `kappa` is a leaf: a new value compiles nothing.

    Two pairs in one place press twice as hard as one. Where positions are concrete, `discretize`
    makes one pair of them; traced ones stay two.

    Of a trajectory of the contact-implicit scheme, lam_i gap_i = 2 tau kappa in every step, i.e.
    (mean contact force) x (gap) = 2 kappa.

    `prepare` and `with_contact` refuse a concrete kappa that is not positive and finite; a traced
    one ends the step as not finite.

    Derivative: forward and reverse mode of every order; kappa counts as constant.
    """

    kappa: float | Array
    """Product of multiplier and separation velocity of every pair, scalar, positive [J]."""

    max_steps: int = field(default=100, metadata={"static": True})
    """Newton steps before a time step ends as not converged."""

    is_exact: ClassVar[bool] = False
    uses_compliance: ClassVar[bool] = False

    @classmethod
    def for_scene(
        cls,
        stepper: PreparedScene,
        initial: StartingState | None = None,
        speed: float | Array | None = None,
    ) -> RelaxedContact:
        """Return the law whose gradient through impacts converges, of the size of a scene.

        kappa = 0.05 v^2 mean(1 / W_ii), v the speed and 1 / W_ii the mass that a pair has within a
        step. `SmoothedContact.for_scene` is smoother in the phase of the touch.

        Args:
            stepper: the prepared scene.
            initial: state at time zero; default at rest without displacement.
            speed: closing speed at touch v, [m/s]; default that of the free flight, see
                `SmoothedContact.for_scene`.

        Raises:
            ValueError: as `SmoothedContact.for_scene`.
        """
        v = closing_speed(stepper, initial, speed)
        mass = jnp.mean(1.0 / stepper.contact_problem.form.compliance_scale)
        return cls(jax.lax.stop_gradient(FRACTION * v**2 * mass))

    @property
    def max_active_sets(self) -> None:
        """None: it works on the condensed compliance."""

    def check(self) -> None:
        """Check what is not traced.

        Raises:
            ValueError: if kappa is not positive and finite, or no Newton step is allowed.
        """
        smooth_law.check("RelaxedContact", "kappa", self.kappa, self.max_steps)

    def first_workspace(self, compliance: Array) -> Array:
        """Return no force, (C,): each step starts from the multiplier of the last one."""
        return jnp.zeros_like(jnp.diagonal(compliance))

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the relaxed problem; see `ContactSolver.solve`.

        Active are the pairs that are nearer to strong contact than to separation, d p > g.
        """
        diagonal = jnp.diagonal(compliance)
        kappa = jax.lax.stop_gradient(jnp.asarray(self.kappa, offset.dtype))
        kappa = poison_unless((kappa > 0.0) & (kappa < jnp.inf), kappa)

        def law(x: Array) -> PairState:
            root = jnp.sqrt(x**2 + 4.0 * diagonal * kappa)
            # Without cancellation: the smaller of p and g from their product.
            large = 0.5 * (jnp.abs(x) + root)
            small = diagonal * kappa / large
            is_closed = x > 0.0
            pushed = jnp.where(is_closed, large, small)
            separated = jnp.where(is_closed, small, large)
            return PairState(pushed / diagonal, separated, pushed / root, separated / root)

        return smooth_law.solve(law, compliance, offset, resolution, guess, self.max_steps)

    def softness(self, compliance: Array | None, multiplier: Array) -> Array:
        """Return -dg/dp = g / p = kappa / p^2, (C,)."""
        del compliance
        return self.kappa / multiplier**2
