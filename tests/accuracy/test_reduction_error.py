"""Claims about the error of a reduced model: what it is estimated to be, it is, within a factor."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.control.inner_product import nodal_norms

#: The promise of `reduction_error`.
FACTOR = 2.0


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=15 / 8, gap=0.2, steps=60)


@pytest.fixture(scope="module")
def reduced(problem):
    return jc.prepare(jc.reduce(problem.system, 12, loads=[problem.reference[0]]), problem.dt)


def uneven(problem):
    """A control that is not symmetric"""
    x = problem.system.points
    return problem.control_scale * problem.reference * (1.0 + 0.5 * jnp.sin(0.2 * x[:, :1]))[None]


def test_reduction_error_is_the_error_within_a_factor_of_two(problem, reduced):
    run = partial(jc.simulate, control=uneven(problem))
    found = jc.reduction_error(problem.system, reduced, run)
    exact, motion = run(problem.stepper), run(reduced)
    squares = partial(nodal_norms, problem.system.nodal_mass)
    difference = squares(motion.displacement - exact.displacement)
    displacement = np.sqrt(np.max(difference) / np.max(squares(exact.displacement)))
    pushed = [np.cumsum(np.sum(x.contact_impulse, axis=1)) for x in (motion, exact)]
    impulse = np.max(np.abs(pushed[0] - pushed[1])) / pushed[1][-1]
    assert displacement / FACTOR < found.displacement < FACTOR * displacement
    assert impulse / FACTOR < found.impulse < FACTOR * impulse
    assert found.quantity is None
    assert found.enriched.size > reduced.system.size + problem.system.normals.count


def test_reduction_error_of_a_number_is_its_difference(problem, reduced):
    control = uneven(problem)

    def height(system):
        motion = jc.simulate(jc.prepare(system, problem.dt), control)
        return jnp.mean(motion.displacement[..., 1])

    found = jc.reduction_error(problem.system, reduced.system, height)
    error = abs(height(problem.system) - height(reduced.system))
    assert found.displacement is None
    assert error / 4.0 < found.quantity < 4.0 * error


def test_reduction_error_refuses_another_system(problem, reduced):
    softer = replace(problem.scene, material=replace(problem.scene.material, young=1e6))
    for scene in (jc.scenes.half_disc(h=5.0), softer):
        with pytest.raises(ValueError, match=r"a model that jc\.reduce made of it"):
            jc.reduction_error(jc.discretize(scene), reduced, partial(jc.simulate, steps=2))
