"""Options that do not fit end in a sentence that says what to write instead."""

import dataclasses
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT, VISCOUS, block, block_scene, discretized

import jaxcontact as jc
from jaxcontact.schemes import Losses, SchemeMatrices, StepResult
from jaxcontact.schemes.terms import impact_loss, trapezoidal_matrix, velocity_bound


@cache
def system():
    return discretized(block_scene(VISCOUS))


@cache
def clamped():
    plane = jc.HalfSpace(np.array([0.0, -0.001]), np.array([0.0, 1.0]))
    load = np.array([0.0, -10.0])
    return discretized(
        jc.Scene(BLOCK, VISCOUS, clamped=("top",), contact={"bottom": plane}, body_force=load)
    )


@dataclasses.dataclass(frozen=True)
class Newmark:
    """A user's own scheme, written after the protocol: the contact-implicit one again."""

    def matrices(self, system, dt):
        return SchemeMatrices(system.mass, (trapezoidal_matrix(system, dt),))

    def first_carry(self, system):
        return ()

    def step(self, system, operators, dt, state, load):
        y, v = state.displacement, state.velocity
        rhs = operators.mass @ v - 0.5 * dt * (system.stiffness @ y - load)
        bound = velocity_bound(system, dt, y, v)
        w, solution = operators.problem.solve(rhs, bound, state.guesses[0])
        return StepResult(y + dt * w, 2 * w - v, 2 * solution.multiplier, (solution,))

    def losses(self, system, operators, dt, old, new):
        return Losses(impact_loss(system, dt, old, new))


def test_a_scheme_written_after_the_protocol_runs_and_keeps_its_ledger():
    stepper = jc.prepare(system(), DT, scheme=Newmark())
    trajectory = jc.simulate(stepper, steps=12)
    expected = jc.simulate(jc.prepare(system(), DT), steps=12)
    np.testing.assert_array_equal(trajectory.displacement, expected.displacement)
    assert np.any(trajectory.active)
    assert np.max(np.abs(jc.energy(stepper, trajectory).residual)) < 1e-12


@pytest.mark.parametrize("solver", [jc.ProjectedGaussSeidel(), jc.RelaxedContact(1e-6)])
def test_conjugate_gradients_refuse_a_contact_solver_that_needs_the_compliance(solver):
    options = {"linear_solver": jc.ConjugateGradient(), "contact_solver": solver}
    with pytest.raises(ValueError, match=r"jc\.SemismoothNewton\(\).*jc\.NestedDissection\(\)"):
        jc.prepare(system(), DT, **options)
    with pytest.raises(ValueError, match=r"jc\.SemismoothNewton\(\)"):
        jc.solve_static(clamped(), **options)
    stepper = jc.prepare(system(), DT, linear_solver=jc.ConjugateGradient())
    with pytest.raises(ValueError, match=r"jc\.NestedDissection\(\)"):
        jc.with_contact(stepper, solver)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"contact_solver": jc.Dense()}, "contact_solver must be .* jc.SemismoothNewton"),
        ({"contact_solver": jc.SemismoothNewton}, "contact_solver must be .* jc.SemismoothNewton"),
        ({"scheme": jc.SemismoothNewton()}, "scheme must be .* jc.ContactImplicit"),
        ({"scheme": jc.ContactStabilized}, "scheme must be .* jc.ContactStabilized"),
        ({"scheme": "newmark"}, "scheme must be .* jc.ContactImplicit"),
        ({"linear_solver": "dense"}, "linear_solver must be .* jc.NestedDissection"),
        ({"linear_solver": jc.SemismoothNewton()}, "linear_solver must be .* jc.NestedDissection"),
    ],
)
def test_prepare_says_what_an_option_must_be(options, advice):
    with pytest.raises(ValueError, match=advice):
        jc.prepare(system(), DT, **options)


@pytest.mark.parametrize("dt", [True, 0.0, -1.0, np.nan, np.inf, np.ones(2)])
def test_prepare_refuses_a_step_length_that_is_none(dt):
    with pytest.raises(ValueError, match="dt must be a positive number of seconds"):
        jc.prepare(system(), dt)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"weak_contact": 3}, "weak_contact must be .* jc.ClosedBranch"),
        ({"weak_contact": jc.SemismoothNewton()}, "weak_contact must be .* jc.ClosedBranch"),
        ({"weak_contact": jc.OpenBranch}, "weak_contact must be .* jc.OpenBranch"),
        ({"checkpoint": 4}, "checkpoint must be .* jc.Checkpoint"),
        ({"save_every": 0}, "save_every=0 must be a positive divisor"),
        ({"save_every": True}, "save_every=True must be a positive divisor"),
    ],
)
def test_simulate_says_what_an_option_must_be(options, advice):
    with pytest.raises(ValueError, match=advice):
        jc.simulate(block(), steps=4, **options)


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"contact_solver": jc.SemismoothNewton}, "contact_solver must be .* jc.SemismoothNewton"),
        ({"linear_solver": "dense"}, "linear_solver must be .* jc.NestedDissection"),
    ],
)
def test_solve_static_says_what_an_option_must_be(options, advice):
    with pytest.raises(ValueError, match=advice):
        jc.solve_static(clamped(), **options)


def test_trajectory_knows_its_step_and_its_forces():
    trajectory = jc.simulate(block(), steps=12)
    assert float(trajectory.dt) == DT
    np.testing.assert_array_equal(trajectory.contact_force, trajectory.contact_impulse / DT)
    batch = jax.vmap(lambda v: jc.simulate(block(), steps=12, initial=v))(
        jax.tree.map(lambda x: jnp.stack([x, x]), jc.State(*2 * [jnp.zeros((BLOCK.n_nodes, 2))]))
    )
    np.testing.assert_allclose(batch.contact_force[1], trajectory.contact_force, atol=1e-9)
    np.testing.assert_array_equal(batch.active[1], trajectory.active)
    np.testing.assert_array_equal(batch.weak[1], trajectory.weak)


def test_cost_refuses_another_step_than_that_of_the_motion():
    stepper = block()
    trajectory = jc.simulate(stepper, steps=4)
    target = jnp.zeros_like(trajectory.displacement)
    cost = jc.TrackingCost(system(), dt=2 * DT, target=target)
    with pytest.raises(ValueError, match=r"dt=0.04.*0.02"):
        cost(trajectory)
    # Under jit nothing can raise, but no number comes out either.
    assert np.isnan(jax.jit(lambda stepper: cost(jc.simulate(stepper, steps=4)))(stepper))
    right, silent = (jc.TrackingCost(system(), target=target, **o) for o in ({"dt": DT}, {}))
    assert right(trajectory) == silent(trajectory) > 0.0
    with pytest.raises(ValueError, match=r"dt=0.04.*0.02"):
        jc.contact_force(trajectory, dt=2 * DT)
    force = jc.contact_force(trajectory)
    np.testing.assert_array_equal(force, jc.contact_force(trajectory, dt=DT))
