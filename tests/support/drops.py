"""A bar that falls on the floor, whose gradient through the impact is known, and other impacts."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

#: Young's modulus 900, density 1, length 10, gravity 10, height 5: v = 10 m/s, impact of 2/3 s.
EXACT = jc.reference.FallingBar()
SPEED = 10.0
#: d(height)/d(drop height) at the time 2.4: 2 g s / v - 1 with s the time since the bounce.
END, SLOPE = 2.4, 7.0 / 15.0
PHASES = 8


def bar(
    n, *, scheme=None, dtype=jnp.float64, linear_solver=None, courant=1.0, mesh=None, **viscous
):
    """The prepared bar of n cells, (stepper, steps)"""
    h = EXACT.length / n
    scene = jc.Scene(
        mesh=jc.meshes.interval(EXACT.length, h=h) if mesh is None else mesh,
        material=jc.KelvinVoigt(young=EXACT.young, poisson=0.0, **viscous),
        contact={"left": jc.HalfSpace(point=np.array([-EXACT.gap]), normal=np.array([1.0]))},
        body_force=np.array([-EXACT.gravity]),
    )
    dt = courant * h / 30.0

    def prepare():
        system = jc.discretize(scene, dtype=dtype)
        return jc.prepare(system, dt, scheme=scheme, linear_solver=linear_solver)

    return jax.jit(prepare)(), round(END / dt)


def dropped_from(stepper, higher):
    """A stepper whose gaps are larger by a distance"""
    system = stepper.system
    return replace(stepper, system=system.with_gap(system.gap + higher))


def final_height(stepper, steps, higher):
    """Height of the centre of mass at the end"""
    motion = jc.simulate(dropped_from(stepper, higher), steps=steps)
    weights = stepper.system.nodal_mass @ jnp.ones_like(motion.displacement[-1])
    return higher + jnp.sum(weights * motion.displacement[-1]) / jnp.sum(weights)


@partial(jax.jit, static_argnums=1)
def slopes(stepper, steps):
    """d(height)/d(drop height) for touches at equally spaced phases of a step, (8,)"""
    higher = SPEED * stepper.dt * jnp.arange(PHASES) / PHASES
    slope = jax.grad(final_height, argnums=2)
    return jax.lax.map(lambda x: slope(stepper, steps, x), higher.astype(stepper.system.dtype))


def bias_and_spread(stepper, steps):
    """Mean over exact value minus one, and standard deviation over exact value"""
    found = np.asarray(slopes(stepper, steps), float)
    return found.mean() / SLOPE - 1.0, found.std() / SLOPE
