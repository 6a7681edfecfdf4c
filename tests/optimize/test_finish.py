"""The exact finish of a homotopy: the pattern of contact, and what its certificate proves."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.kinked import START, grazing, minimizer

import jaxcontact as jc
from jaxcontact.control.problem import Problem
from jaxcontact.motion.stepper import StepPerturbation, with_perturbation
from jaxcontact.optimize.certificate import motion_of
from jaxcontact.optimize.pattern import Pattern

#: Rounding of 60 steps and of the mass solve of the inner product.
EXACT = 1e-11
STEPS = 60


@pytest.fixture(scope="module")
def disc():
    """A coarse half disc that is pressed down by a load which lifts it in the end."""
    return jc.scenes.half_disc_control(h=5.0, steps=STEPS, dt=1.2e-4)


@pytest.fixture(scope="module")
def result(disc):
    return jc.optimize(
        disc.objective,
        jnp.zeros_like(disc.reference),
        method=jc.Homotopy(),
        system=disc.system,
        dt=disc.dt,
    )


def problem_of(scene, start):
    return Problem.of(scene.objective, start, system=scene.system, dt=scene.dt)


def test_finish_ends_at_the_kinked_minimiser_to_rounding():
    problem = grazing()
    result = jc.optimize(problem.objective, START, method=jc.Homotopy(), **problem.options)
    np.testing.assert_allclose(result.control, minimizer(problem), atol=1e-12)
    assert result.status is jc.Ending.CERTIFIED
    assert result.stationarity.residual < EXACT * result.history.gradient_norm[0]


def test_finish_is_strongly_stationary_with_weak_contact(result):
    certificate = result.stationarity
    assert result.status is jc.Ending.CERTIFIED
    assert certificate.residual < EXACT * result.history.gradient_norm[0]
    assert certificate.is_strong
    assert len(certificate.weak_pairs) > 0
    assert certificate.rank == len(certificate.weak_pairs)
    assert "0 with a wrong sign" in str(certificate)


def test_finish_with_bounds_is_strongly_stationary(disc, result):
    # Half of the largest force: most of the control is at a bound.
    largest = 0.5 * float(jnp.max(jnp.abs(result.control)))
    bounded = jc.optimize(
        disc.objective,
        jnp.zeros_like(disc.reference),
        method=jc.Homotopy(),
        bounds=(-largest, largest),
        system=disc.system,
        dt=disc.dt,
    )
    assert bounded.status is jc.Ending.CERTIFIED
    assert float(jnp.max(jnp.abs(bounded.control))) == largest
    assert 10 < np.sum(np.abs(np.asarray(bounded.control)) == largest)
    certificate = bounded.stationarity
    assert certificate.is_strong
    assert certificate.residual < EXACT * result.history.gradient_norm[0]


def test_certified_control_is_a_local_minimiser_with_growth(disc, result):
    # Strong stationarity on convex quadratic pieces: J(u + d) - J(u) >= alpha/2 |d|^2.
    value = jax.jit(disc.objective)
    keys = jax.random.split(jax.random.PRNGKey(0), 100)
    least = float(value(result.control))
    for k, key in enumerate(keys):
        direction = jax.random.normal(key, result.control.shape)
        size = jc.control_dot(disc.system, disc.dt, direction, direction) ** 0.5
        length = 10.0 ** -(2 + k % 4)
        growth = float(value(result.control + length / size * direction)) - least
        assert growth >= 0.5 * disc.control_weight * length**2 - 1e-15 * least


@pytest.mark.parametrize("size", [1e-9, 1e-7])
def test_certificate_of_a_perturbed_control_finds_the_same_weak_pairs(disc, result, size):
    rng = np.random.default_rng(0)
    near = result.control * (1.0 + size * rng.normal(size=result.control.shape))
    certificate = jc.stationarity(disc.objective, near, system=disc.system, dt=disc.dt)
    np.testing.assert_array_equal(certificate.weak_pairs, result.stationarity.weak_pairs)
    assert certificate.wrong_signs == 0
    assert certificate.residual < 100.0 * size * result.history.gradient_norm[0]


def test_motion_on_its_own_pattern_is_the_motion_and_affine(disc):
    rng = np.random.default_rng(1)
    u = disc.reference
    motion = disc.simulate(u)
    assert 10 < np.sum(motion.active) < motion.active.size
    fixed = with_perturbation(disc, StepPerturbation(closed=motion.contact.active))
    np.testing.assert_allclose(
        fixed.simulate(u).displacement, motion.displacement, atol=1e-12, rtol=0.0
    )
    value = jax.jit(fixed.objective)
    d = rng.normal(size=u.shape)
    values = [float(value(u + t * d)) for t in (-1.0, 0.0, 1.0, 2.0)]
    assert abs(np.diff(values, n=3)[0]) < 1e-13 * max(values)
    gradient = jax.jit(jax.grad(fixed.objective))(u)
    np.testing.assert_allclose(gradient, jax.jit(jax.grad(disc.objective))(u), atol=1e-14)


def test_finish_mends_a_wrong_pattern(disc, result):
    # Two weak pairs forgotten, two more claimed.
    problem = problem_of(disc, result.control)
    motion = motion_of(problem)
    contact = disc.simulate(result.control).contact
    weak = np.zeros(contact.active.shape, bool)
    k, i = result.stationarity.weak_pairs.T
    weak[k, 0, i] = True
    strong = np.asarray(contact.active) & ~weak
    wrong = weak.copy()
    wrong[k[:1], 0, i[:1]] = False
    claimed = np.argwhere(strong)[:1]
    wrong[tuple(claimed.T)] = True
    end = jc.ExactFinish().run(
        problem,
        motion,
        result.control,
        Pattern(strong & ~wrong, wrong),
        float(result.history.gradient_norm[0]),
    )
    # Strongly stationary controls lie close together: it may be another one.
    assert end.is_right
    assert float(disc.objective(end.parameters)) == pytest.approx(result.value, rel=1e-2)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pressed:
    """The half disc under a cost that is not quadratic on a pattern, with a target of force."""

    disc: jc.scenes.ControlProblem
    force: jax.Array

    def simulate(self, u):
        return self.disc.simulate(u)

    def objective(self, u):
        motion = self.simulate(u)
        missing = jnp.sum(motion.contact_force, axis=1) - self.force
        miss = jnp.mean(missing**2) / jnp.mean(self.force**2)
        effort = jc.control_dot(self.disc.system, self.disc.dt, u, u)
        return miss + 0.1 * miss**2 + self.disc.control_weight * effort


def test_finish_of_a_force_target_takes_newton_steps_on_the_pattern(disc):
    start = disc.reference
    problem = Pressed(disc, 1.5 * jnp.sum(disc.simulate(start).contact_force, axis=1))
    result = jc.optimize(
        problem.objective, start, method=jc.Homotopy(), system=disc.system, dt=disc.dt
    )
    assert result.status is jc.Ending.CERTIFIED
    assert result.stationarity.is_strong
    assert result.stationarity.residual < EXACT * result.history.gradient_norm[0]
    assert result.value < 0.1 * float(problem.objective(start))


def cost(stepper, u):
    return jnp.sum((jc.simulate(stepper, u).displacement[-1] - 0.05) ** 2) + 1e-3 * jnp.sum(u**2)


def test_homotopy_without_a_motion_follows_the_path():
    problem = grazing()
    objective = jax.tree_util.Partial(cost, problem.stepper)
    result = jc.optimize(objective, START, method=jc.Homotopy(levels=7), **problem.options)
    assert result.status is jc.Ending.RELAXED


def test_hessian_product_is_the_derivative_of_the_gradient(disc):
    problem = problem_of(disc, disc.reference)
    direction = jnp.asarray(np.random.default_rng(2).normal(size=disc.reference.shape))
    product = problem.hessian(disc.reference)(direction)
    expected = jax.jvp(jax.grad(disc.objective), (disc.reference,), (direction,))[1]
    np.testing.assert_allclose(product, expected, rtol=1e-9, atol=1e-12)
