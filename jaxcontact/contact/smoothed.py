"""Smoothed contact: a law that is soft over one time step of the touch, for derivatives.

    p = (s / d) ln(1 + exp(x / s)),    g = s ln(1 + exp(-x / s)),    x = d p - g,    d = diag W,

in other words exp(-d p / s) + exp(-g / s) = 1: a force decays with the gap over the range s dt. The
speed s is a fraction of the closing speed v at touch. Through an impact the derivative of exact
contact depends on the phase of the touch within its step, and does not converge; this law averages
over that phase. One period of it is a change v of x, at which the law lets the share z / sinh z,
z = 2 pi^2 s / v, of the oscillation through: 0.6 % at s = 0.4 v.

Source: MATH.md 8; Chen, Mangasarian, Comput. Optim. Appl. 5 (1996) 97-138 for the softplus.
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

#: s in units of the closing speed. By z / sinh z half of it would let 15 % of the dependence on the
#: phase through; more of it smooths the motion more.
RANGE = 0.4

#: Below this Courant number of the contact nodes `for_scene` takes a range of the whole speed: the
#: touch is spread over many steps, each of which the law must bridge.
SMALL_COURANT = 0.2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SmoothedContact:
    """Smooth contact whose gradient through impacts converges with the mesh.

    A pair feels the obstacle within some s dt, s = 0.4 `speed`, in front of it and never touches;
    in rest it stays where its load is carried, -s dt ln(1 - exp(-d p / s)) away. Farther off there
    is no force, and no gradient before touch: for starts that do not touch use `RelaxedContact`.
    Take exact contact for the motion, its forces and its certificates, and this law for derivatives
    through impacts, with `ContactImplicit`: one run gives the gradient that a mean over all phases
    of the touch would have. Rather give a speed that is too large than one that is too small;
    through several impacts, whose ripples multiply, take 1.5 times of it. It is a leaf: a new value
    compiles nothing.

    `prepare` and `with_contact` refuse a concrete speed that is not positive and finite; a traced
    one ends the step as not finite.

    Derivative: forward and reverse mode of every order; the speed counts as constant.
    """

    speed: float | Array
    """Closing speed of a pair at touch, scalar, positive [m/s]."""

    max_steps: int = field(default=100, metadata={"static": True})
    """Newton steps before a time step ends as not converged."""

    is_exact: ClassVar[bool] = False
    uses_compliance: ClassVar[bool] = True

    @classmethod
    def for_scene(
        cls,
        stepper: PreparedScene,
        initial: StartingState | None = None,
        speed: float | Array | None = None,
    ) -> SmoothedContact:
        """Return the law of the size of a scene: its speed is the closing speed at touch.

        Where the Courant number c dt / h is below 0.2 it is 2.5 times that, s = v.

        Args:
            stepper: the prepared scene.
            initial: state at time zero; default at rest without displacement.
            speed: closing speed at touch, [m/s]; default that of the free flight,
                v^2 = max(N v, 0)^2 + 2 max(N a, 0) gap, with the load of a body without clamps over
                its mass as a. A closed gap without initial state is a drop from as high as the
                scene is large.

        Raises:
            ValueError: if a concrete speed is not positive and finite, or nothing flies at an
                obstacle.
        """
        v = closing_speed(stepper, initial, speed)
        courant = jax.lax.stop_gradient(_courant_number(stepper))
        return cls(jnp.where(courant < SMALL_COURANT, v / RANGE, v))

    @property
    def max_active_sets(self) -> None:
        """None: it works on the condensed compliance."""

    def check(self) -> None:
        """Check what is not traced.

        Raises:
            ValueError: if the speed is not positive and finite, or no Newton step is allowed.
        """
        smooth_law.check("SmoothedContact", "speed", self.speed, self.max_steps)

    def first_workspace(self, compliance: Array) -> Array:
        """Return no force, (C,): each step starts from the multiplier of the last one."""
        return jnp.zeros_like(jnp.diagonal(compliance))

    def solve(self, compliance: Array, offset: Array, resolution: Array, guess: Guess) -> Solution:
        """Solve the smoothed problem; see `ContactSolver.solve`.

        Active are the pairs that are nearer to strong contact than to separation, d p > g.
        """
        diagonal, s = jnp.diagonal(compliance), self._range(offset.dtype)

        def law(x: Array) -> PairState:
            z = x / s
            closed, open = jax.nn.sigmoid(z), jax.nn.sigmoid(-z)
            p, g = s * jax.nn.softplus(z) / diagonal, s * jax.nn.softplus(-z)
            return PairState(p, g, closed, open)

        return smooth_law.solve(law, compliance, offset, resolution, guess, self.max_steps)

    def softness(self, compliance: Array | None, multiplier: Array) -> Array:
        """Return -dg/dp = d / (exp(d p / s) - 1), (C,); infinite where that is d / eps."""
        assert compliance is not None
        pushed = compliance * multiplier / self._range(multiplier.dtype)
        is_open = pushed < jnp.finfo(pushed.dtype).eps
        return jnp.where(is_open, jnp.inf, compliance / jnp.expm1(jnp.where(is_open, 1.0, pushed)))

    def _range(self, dtype: jnp.dtype) -> Array:
        speed = jax.lax.stop_gradient(jnp.asarray(self.speed, dtype))
        return RANGE * poison_unless((speed > 0.0) & (speed < jnp.inf), speed)


def _courant_number(stepper: PreparedScene) -> Array:
    """Return the largest c dt / h of the contact nodes, scalar; exact for a uniform bar.

    From n.An / n.Mn with n a row of N: E / h over rho h / 3 in a bar.
    """
    system, normals = stepper.system, stepper.system.normals
    squares = normals.weights**2
    stiffness = jnp.sum(squares * normals.touched(system.stiffness.diagonal()), axis=1)
    mass = jnp.sum(squares * normals.touched(system.mass.diagonal()), axis=1)
    return stepper.dt * jnp.sqrt(jnp.max(stiffness / mass, initial=0.0) / 3.0)
