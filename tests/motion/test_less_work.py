"""Claims about what is not computed when it is not asked for, by the operations XLA counts.

A loop counts as one step.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc

STEPS, DT = 30, 0.02


def scene(*, young=100.0, contact=True):
    return jc.Scene(
        mesh=jc.meshes.rectangle((1.0, 0.5), h=0.125),
        material=jc.KelvinVoigt(young=young, poisson=0.3),
        clamped=("top",),
        contact={"bottom": jc.HalfSpace(point=[0.0, -9.0], normal=[0.0, 1.0])} if contact else {},
        body_force=[0.0, -1.0],
    )


def flops(function, *arguments):
    analysis = jax.jit(function).lower(*arguments).compile().cost_analysis()
    return analysis["flops"]


def motion(stepper):
    return jc.simulate(stepper, steps=STEPS)


def test_contact_out_of_reach_costs_what_no_contact_costs():
    system = jc.discretize(scene())
    linear = {"linear_solver": jc.Dense()}
    reachable, pruned, without = (
        flops(lambda s: motion(s).unknowns, jc.prepare(x, DT, **linear))
        for x in (system, system.with_pairs(system.gap < 1.0), jc.discretize(scene(contact=False)))
    )
    assert pruned < 1.1 * without
    assert reachable > 1.2 * without


def test_fields_of_a_reduced_model_are_lifted_one_by_one():
    system = jc.reduce(jc.discretize(scene()), 10)
    stepper = jc.prepare(system, DT)
    neither, one, both = (
        flops(function, stepper)
        for function in (
            lambda s: jnp.sum(motion(s).unknowns),
            lambda s: jnp.sum(motion(s).displacement ** 2),
            lambda s: jnp.sum(motion(s).displacement ** 2 + motion(s).velocity ** 2),
        )
    )
    lift = 2 * (STEPS + 1) * system.basis.vectors.size
    assert one - neither > lift
    assert both - one > lift


@pytest.mark.parametrize("name", ["nodal_mass", "l2_mass"])
def test_masses_of_controls_are_not_assembled_without_a_control(name):
    def final(young, *, with_mass):
        system = jc.discretize(scene(young=young))
        end = motion(jc.prepare(system, DT, linear_solver=jc.Dense())).unknowns[-1]
        return end, (getattr(system, name).expand() if with_mass else None)

    without, beside = (flops(partial(final, with_mass=x), 100.0) for x in (False, True))
    assert beside - without > np.prod(scene().mesh.cells.shape)
