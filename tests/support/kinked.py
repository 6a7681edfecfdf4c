"""A control problem whose minimiser lies on a kink and is known by hand.

One mass m on a spring k (a bar of one cell, clamped left) makes two steps of the scheme under the
loads f_1, f_2 towards a wall at the distance psi:

    y_2 = min(c_1 f_1 + c_2 f_2, psi),      D = m + tau^2 k / 4,
    c_2 = tau^2 / (2 D),    c_1 = c_2 (1 + (2 m - tau^2 k / 2) / D).

J = weight/2 (y_2 - target)^2 + alpha/2 |u|^2 with f_i = L u_i. For a target behind the wall it is
useless to press on, and the best control is the shortest one that grazes the wall: c.f = psi.
With a load f_i = L_11 u_i on the free node that is u = psi c / (L_11 c.c), independent of weight.
"""

from dataclasses import dataclass, field
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

WALL = 0.1
DT = 0.2


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Grazing:
    stepper: jc.Stepper
    target: float | jax.Array
    weight: float = field(default=100.0, metadata={"static": True})
    alpha: float = field(default=0.05, metadata={"static": True})

    def simulate(self, u):
        return jc.simulate(self.stepper, u)

    def objective(self, u):
        miss = self.simulate(u).displacement[-1, 1, 0] - self.target
        control = jc.control_dot(self.stepper.system, self.stepper.dt, u, u)
        return 0.5 * self.weight * miss**2 + 0.5 * self.alpha * control

    @property
    def options(self):
        return {"system": self.stepper.system, "dt": DT}


def grazing(target=0.15, dtype=jnp.float64, **options):
    """The problem; targets beyond the wall put the minimiser on the kink."""
    # A contact solver may hold an array, which is no key.
    prepare = _prepare.__wrapped__ if "contact_solver" in options else _prepare
    return Grazing(prepare(dtype, **options), target)


@cache
def _prepare(dtype, **options):
    scene = jc.Scene(
        mesh=jc.meshes.interval(1.0, h=1.0),
        material=jc.KelvinVoigt(young=4.0, poisson=0.0, density=3.0),
        clamped=("left",),
        contact={"right": jc.HalfSpace(point=np.array([1.0 + WALL]), normal=np.array([-1.0]))},
    )
    # One program instead of a hundred small ones.
    return jax.jit(lambda: jc.prepare(jc.discretize(scene, dtype=dtype), DT, **options))()


def influence(problem):
    """c, (2,), by hand: m = 3/3, k = 4."""
    mass, spring = 1.0, 4.0
    matrix = mass + DT**2 * spring / 4
    last = DT**2 / (2 * matrix)
    return last * np.array([1 + (2 * mass - DT**2 * spring / 2) / matrix, 1.0])


def minimizer(problem):
    """The best control (2, 2, 1) by hand; L_11 = 1/3."""
    c = influence(problem)
    u = np.zeros((2, 2, 1))
    u[:, 1, 0] = WALL * c / (c @ c) * 3.0
    return jnp.asarray(u)


def multipliers(problem):
    """nu and pi at the minimiser by hand.

    Open derivative: dJ/df = alpha f tau / L_11 + weight (psi - target) c, gap = psi - y_2, so
    alpha tau f / L_11 = (weight (target - psi) - nu) c. An impulse z on the mass in step two moves
    y_2 by -e with e = tau / D: pi = -dJ/dy e - nu e = (weight (target - psi) - nu) e.
    """
    c = influence(problem)
    share = problem.alpha * 3.0 * DT * WALL / (c @ c)
    matrix = 1.0 + DT**2
    return problem.weight * (problem.target - WALL) - share, share * DT / matrix


START = jnp.asarray([[[0.0], [40.0]], [[0.0], [0.0]]])
