"""The certificate of strong stationarity with every linear solver, scheme and reduced model."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from support.kinked import DT, grazing, minimizer, multipliers

import jaxcontact as jc

ROUNDING = 1e-10


def test_stationarity_with_conjugate_gradients_has_the_multipliers_by_hand():
    problem = grazing(linear_solver=jc.ConjugateGradient())
    certificate = jc.stationarity(problem.objective, minimizer(problem), **problem.options)
    nu, pi = multipliers(problem)
    np.testing.assert_allclose(certificate.gap_multiplier, [nu], rtol=1e-8)
    np.testing.assert_allclose(certificate.impulse_multiplier, [pi], rtol=1e-8)
    assert certificate.residual < 1e-8
    assert certificate.is_strong


def test_optimize_certifies_with_conjugate_gradients():
    problem = grazing(linear_solver=jc.ConjugateGradient())
    result = jc.optimize(problem.objective, minimizer(problem), iterations=1, **problem.options)
    assert result.stationarity is not None
    assert result.stationarity.residual < 1e-8


BAR = jc.discretize(
    jc.Scene(
        mesh=jc.meshes.interval(1.0, h=0.25),
        material=jc.KelvinVoigt(young=4.0, poisson=0.0, density=3.0),
        clamped=("left",),
        contact={"right": jc.HalfSpace(point=np.array([1.1]), normal=np.array([-1.0]))},
    )
)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Landing:
    """Bring the tip of a bar behind its wall."""

    stepper: jc.Stepper

    def simulate(self, u):
        return jc.simulate(self.stepper, u)

    def objective(self, u):
        miss = self.simulate(u).displacement[-1, -1, 0] - 0.15
        return 50.0 * miss**2 + 0.025 * jc.control_dot(self.stepper.system, DT, u, u)

    @property
    def options(self):
        return {"system": self.stepper.system, "dt": DT}


def touching(problem, contact_problem=0, first=3):
    """A control (4, 5, 1) from a step on with which the last step just touches the wall"""
    one = jnp.zeros((4, 5, 1)).at[first:, -1].set(1.0)
    gap = jax.jit(lambda size: problem.simulate(size * one).contact.gap[-1, contact_problem, 0])
    low, high = 0.0, 1000.0
    assert gap(low) > 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if gap(middle) > 1e-15 else (low, middle)
    return high * one


def test_stationarity_of_a_reduced_model_is_that_of_the_full_one():
    # Three vibrations and the response to the contact span all four unknowns.
    full = Landing(jc.prepare(BAR, DT))
    reduced = Landing(jc.prepare(jc.reduce(BAR, modes=3), DT))
    u = touching(full)
    expected, found = (jc.stationarity(x.objective, u, **x.options) for x in (full, reduced))
    np.testing.assert_array_equal(expected.weak_pairs, [[3, 0]])
    np.testing.assert_array_equal(found.weak_pairs, [[3, 0]])
    for name in ("gap_multiplier", "impulse_multiplier", "residual", "gradient_norm"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-7)
    assert 0.0 < expected.residual < expected.gradient_norm


def test_stationarity_counts_the_predictor_of_a_scheme():
    problem = Landing(jc.prepare(BAR, DT, scheme=jc.ContactStabilized()))
    certificate = jc.stationarity(
        problem.objective, touching(problem, 1, first=2), **problem.options
    )
    assert 1 in certificate.contact_problem
    assert np.all(np.isfinite([certificate.residual, *certificate.impulse_multiplier]))
