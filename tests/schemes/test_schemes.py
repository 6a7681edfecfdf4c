"""The schemes: each step satisfies its equations, and each ledger closes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import bodies
from support.bodies import SCHEMES

import jaxcontact as jc
from jaxcontact.schemes.mass_redistribution import redistribute

#: What is said of a force that chatters is in `test_chatter.py`.
pytestmark = pytest.mark.filterwarnings("ignore::jaxcontact.ChatterWarning")

by_scheme = pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: type(s).__name__)
STEPS = 25
SLANTED = (0.3, 1.0)


@functools.cache
def slanted_block():
    return bodies.discretized(bodies.block_scene(bodies.VISCOUS, normal=SLANTED, gap=0.05))


@functools.cache
def throw(scheme):
    """A block that falls on a slanted plane under a random control; stepper, trajectory, control"""
    system = slanted_block()
    stepper = jc.prepare(system, bodies.DT, scheme=scheme)
    control = bodies.random_control(STEPS)
    initial = jc.State(jnp.zeros((system.n_nodes, 2)), jnp.full((system.n_nodes, 2), -1.0))
    trajectory = jc.simulate(stepper, control, initial=initial)
    assert jnp.any(trajectory.contact_impulse > 0.0)
    return stepper, trajectory, control


def dense(stepper):
    system = stepper.system
    matrices = (system.mass, system.stiffness, system.viscosity)
    M, A, B = (m.to_scipy().toarray() for m in matrices)
    return M, A, B, system.normals.to_scipy(system.size).toarray()


def histories(stepper, trajectory, control):
    """y, v (T+1, n), lam (T, C), f (T, n) and the dense matrices"""
    system = stepper.system
    y, v = system.restrict(trajectory.displacement), system.restrict(trajectory.velocity)
    load = jax.vmap(lambda u: system.load + system.control_load(u))(control)
    lam = trajectory.contact_impulse
    return *map(np.asarray, (y, v, lam, load)), *dense(stepper)


def assert_small(values, scale, tolerance=1e-11):
    assert np.abs(values).max() < tolerance * np.abs(scale).max()


def assert_complementary(force, gap):
    """Both not negative, never both positive; gap to rounding of displacements of size 1"""
    assert force.min() >= 0.0
    assert gap.min() > -1e-13
    assert np.abs(force * gap).max() < 1e-12 * np.abs(force).max()


@by_scheme
def test_scheme_closes_its_energy_ledger_to_rounding(scheme):
    stepper, trajectory, control = throw(scheme)
    ledger = jc.energy(stepper, trajectory, control)
    assert jnp.max(jnp.abs(ledger.residual)) < 1e-12 * jnp.max(ledger.total)
    assert jnp.max(ledger.impact_loss) > 1e-4 * ledger.total[0]  # a claim about contact
    assert jnp.all(ledger.viscous_loss >= 0.0)


@pytest.mark.parametrize(
    "scheme", [s for s in SCHEMES if not isinstance(s, jc.RedistributedMass)], ids=str
)
def test_scheme_balances_momentum_in_every_step(scheme):
    stepper, trajectory, control = throw(scheme)
    y, v, lam, f, M, A, B, N = histories(stepper, trajectory, control)
    w = np.diff(y, axis=0) / bodies.DT
    is_euler = isinstance(scheme, jc.BackwardEuler)
    middle = y[1:] if is_euler else (y[1:] + y[:-1]) / 2
    change = np.diff(v, axis=0) @ M
    assert_small(change + bodies.DT * (middle @ A + w @ B - f) + lam @ N, change)


@by_scheme
def test_scheme_gives_complementary_contact(scheme):
    _, trajectory, _ = throw(scheme)
    force, gap = np.asarray(trajectory.contact_impulse), np.asarray(trajectory.gap[1:])
    if isinstance(scheme, jc.Trapezoidal):
        # Its impulse is dt times the mean of the forces at both ends; the force is complementary.
        ends, last = [], np.zeros(force.shape[1])
        for mean in force / bodies.DT:
            last = 2 * mean - last
            ends.append(np.where(np.abs(last) < 1e-9 * force.max() / bodies.DT, 0.0, last))
        force = np.array(ends)
    assert_complementary(force, gap)


def test_backward_euler_velocity_is_the_difference_quotient():
    stepper, trajectory, _ = throw(jc.BackwardEuler())
    quotient = jnp.diff(trajectory.displacement, axis=0) / stepper.dt
    assert_small(quotient - trajectory.velocity[1:], quotient)


@pytest.mark.parametrize("scheme", [jc.ContactImplicit(), jc.Trapezoidal()], ids=str)
def test_scheme_has_the_mean_velocity_in_the_middle(scheme):
    stepper, trajectory, _ = throw(scheme)
    quotient = jnp.diff(trajectory.displacement, axis=0) / stepper.dt
    mean = (trajectory.velocity[1:] + trajectory.velocity[:-1]) / 2
    assert_small(quotient - mean, quotient)


def test_contact_stabilized_predictor_is_the_mass_projection():
    stepper, trajectory, control = throw(jc.ContactStabilized())
    y, v, _, _, M, _, _, N = histories(stepper, trajectory, control)
    u = np.diff(y, axis=0) / bodies.DT - np.diff(v, axis=0) / 2
    taken = (v[:-1] - u) @ M
    mu = taken @ N.T  # the rows of N are orthonormal
    assert_small(taken - mu @ N, taken)
    assert mu.max() > 0.0
    gap = np.asarray(stepper.system.gap) - (y[:-1] + bodies.DT * u) @ N.T
    assert gap.min() > -1e-13
    assert np.abs(mu * gap).max() < 1e-12 * mu.max()
    assert mu.min() > -1e-11 * mu.max()


def test_redistributed_mass_balances_contact_rows_statically_and_others_in_the_mean():
    stepper, trajectory, control = throw(jc.RedistributedMass())
    y, v, lam, f, _, A, B, N = histories(stepper, trajectory, control)
    M = stepper.operators.mass.to_scipy().toarray()
    w = np.diff(y, axis=0) / bodies.DT
    Q = N.T @ N
    R = np.eye(len(Q)) - Q
    static = (y[1:] @ A + w @ B - f) @ N.T + lam / bodies.DT
    assert_small(static, lam / bodies.DT)
    velocity = w @ R + (v[:-1] + v[1:]) / 2 @ Q  # B sees the mean of both ends in contact rows
    change = np.diff(v, axis=0) @ M
    inner = change + bodies.DT * ((y[1:] + y[:-1]) / 2 @ A + velocity @ B - f)
    assert_small(inner @ R, change)
    assert_small((v[1:] - w) @ Q, v)


def fly(scheme):
    """The displacement of the block far from its plane"""
    system = slanted_block()
    if isinstance(scheme, jc.RedistributedMass):  # it would take the mass of the contact nodes
        system = bodies.discretized(dataclasses.replace(bodies.block_scene(), contact={}))
    else:
        system = dataclasses.replace(system, gap=system.gap + 100.0)
    stepper = jc.prepare(system, bodies.DT, scheme=scheme)
    control, initial = bodies.random_control(STEPS), bodies.random_initial()
    return jc.simulate(stepper, control, initial=initial).displacement


@by_scheme
def test_scheme_without_contact_is_trapezoidal_or_implicit_euler(scheme):
    found, expected = fly(scheme), fly(jc.ContactImplicit())
    distance = jnp.max(jnp.abs(found - expected)) / jnp.max(jnp.abs(expected))
    if isinstance(scheme, jc.BackwardEuler):
        assert distance > 1e-2
    else:
        assert distance < 1e-13


@by_scheme
def test_scheme_equals_another_of_its_kind_so_that_nothing_compiles_twice(scheme):
    other = type(scheme)()
    assert (hash(other), other) == (hash(scheme), scheme)
    assert other != SCHEMES[SCHEMES.index(scheme) - 1]


BODIES = {
    "bar": lambda: jc.Scene(
        jc.meshes.interval(1.0, h=0.1),
        bodies.ELASTIC,
        contact={"left": jc.HalfSpace(np.array([-0.1]), np.array([1.0]))},
    ),
    "slanted block": lambda: bodies.block_scene(
        bodies.ELASTIC, normal=SLANTED, mesh=jc.meshes.rectangle((2.0, 1.0), h=0.25)
    ),
    "disc on a ball": lambda: jc.Scene(
        jc.meshes.disc(1.0, h=0.2),
        bodies.ELASTIC,
        contact={"contact": jc.Ball(np.array([0.0, -2.0]), 0.5)},
    ),
    "clamped half disc": jc.scenes.half_disc,
    "box": lambda: jc.Scene(
        jc.meshes.box((1.0, 1.0, 1.0), h=0.25),
        bodies.ELASTIC,
        contact={"bottom": jc.HalfSpace(np.array([0.0, 0.0, -1.0]), np.array([0.3, 0.1, 1.0]))},
    ),
}


@pytest.mark.parametrize("name", BODIES)
def test_redistributed_mass_keeps_total_mass_centre_and_inertia(name):
    system = bodies.discretized(BODIES[name]())
    n, d = len(system.free_nodes), system.dimension
    moved = redistribute(system).to_symmetric(n).to_scipy().toarray()
    M, N = system.mass.to_scipy().toarray(), system.normals.to_scipy(system.size).toarray()
    x = np.asarray(system.points)[system.free_nodes]
    translations = np.tile(np.eye(d), (n, 1))
    # Stretch in 1D, else all rotations: the energies of these fields are the moments.
    skew = [np.eye(1)] if d == 1 else []
    for i in range(d):
        for j in range(i):
            S = np.zeros((d, d))
            S[i, j], S[j, i] = 1.0, -1.0
            skew.append(S)
    fields = np.column_stack([translations, *[(x @ S.T).ravel() for S in skew]])
    moments = fields.T @ M @ fields
    assert_small(fields.T @ moved @ fields - moments, moments, 1e-13)
    assert_small(moved @ N.T, moved, 1e-15)
    values = np.linalg.eigvalsh(moved)
    assert values[0] > -1e-14 * values[-1]
    assert np.count_nonzero(values > 1e-6 * values[-1]) == len(M) - len(N)


def test_redistributed_mass_refuses_a_node_with_two_normals():
    sides = {
        name: jc.HalfSpace(np.array([-0.1, -0.1]), np.array(normal))
        for name, normal in (("left", (1.0, 0.0)), ("bottom", (0.0, 1.0)))
    }
    system = jc.discretize(jc.Scene(bodies.BLOCK, bodies.ELASTIC, contact=sides))
    with pytest.raises(ValueError, match="one normal per node"):
        jc.prepare(system, 0.01, scheme=jc.RedistributedMass())


def test_redistributed_mass_refuses_a_mesh_without_inside():
    mesh = jc.meshes.interval(1.0, h=1.0)
    wall = {
        side: jc.HalfSpace(np.array([x]), np.array([n]))
        for side, x, n in (("left", -1.0, 1.0), ("right", 2.0, -1.0))
    }
    system = jc.discretize(jc.Scene(mesh, bodies.ELASTIC, contact=wall))
    with pytest.raises(ValueError, match="ContactStabilized"):
        jc.prepare(system, 0.01, scheme=jc.RedistributedMass())


def pressed_block(traction=3.0, poisson=0.0):
    """A block that stands on a plane under a uniform traction, held sideways on its left"""
    mesh = jc.meshes.rectangle((2.0, 1.0), h=0.25)
    plane = jc.HalfSpace(np.array([0.0, 0.0]), np.array([0.0, 1.0]))
    material = jc.KelvinVoigt(young=100.0, poisson=poisson, shear_viscosity=5.0, bulk_viscosity=5.0)
    return bodies.discretized(
        jc.Scene(
            mesh, material, contact={"bottom": plane}, traction={"top": np.array([0.0, -traction])}
        )
    )


def test_contact_pressure_of_a_uniformly_pressed_block_is_uniform_to_the_rim():
    system = pressed_block()
    stepper = jc.prepare(system, 0.01, scheme=jc.BackwardEuler())
    pressure = jc.contact_pressure(stepper, jc.simulate(stepper, steps=2000))
    np.testing.assert_allclose(pressure[-1], 3.0, rtol=1e-9)


@by_scheme
def test_contact_pressure_integrates_to_the_impulse(scheme):
    stepper, trajectory, _ = throw(scheme)
    pressure = jc.contact_pressure(stepper, trajectory)
    assert pressure.shape == trajectory.contact_impulse.shape
    impulse = stepper.dt * jnp.sum(pressure * stepper.system.contact_area[None, :], axis=1)
    np.testing.assert_allclose(impulse, jnp.sum(trajectory.contact_impulse, axis=1), rtol=1e-13)


def test_solve_static_presses_a_clamped_block_uniformly():
    mesh = jc.meshes.rectangle((2.0, 1.0), h=0.25)
    plane = jc.HalfSpace(np.array([0.0, 0.1]), np.array([0.0, 1.0]))
    material = jc.KelvinVoigt(young=100.0, poisson=0.0)
    scene = jc.Scene(mesh, material, clamped=("top",), contact={"bottom": plane})
    result = jc.solve_static(bodies.discretized(scene))
    np.testing.assert_allclose(result.contact_pressure, 10.0, rtol=1e-12)  # E strain
    y = mesh.points[:, 1]
    np.testing.assert_allclose(result.displacement[:, 1], 0.1 * (1.0 - y), atol=1e-14)
    assert jnp.all(result.active)


def test_solve_static_is_where_backward_euler_comes_to_rest():
    scene = dataclasses.replace(jc.scenes.half_disc(h=15 / 4), body_force=(0, -3e5))
    system = bodies.discretized(scene)
    static = jc.solve_static(dataclasses.replace(system, gap=system.gap - 0.8))
    stepper = jc.prepare(
        dataclasses.replace(system, gap=system.gap - 0.8), 0.1, scheme=jc.BackwardEuler()
    )
    dynamic = jc.simulate(stepper, steps=200)
    assert jnp.any(static.contact_force > 0.0)
    np.testing.assert_allclose(
        dynamic.displacement[-1], static.displacement, atol=1e-10 * jnp.abs(static.gap).max()
    )
    np.testing.assert_allclose(
        dynamic.contact_impulse[-1] / stepper.dt, static.contact_force, rtol=1e-8, atol=1e-3
    )


def test_solve_static_derivative_of_the_load_by_the_gap_is_its_difference_quotient():
    system = bodies.discretized(jc.scenes.half_disc(h=15 / 8, gap=-0.3))

    def load(depth):
        gap = system.gap - depth
        return jnp.sum(jc.solve_static(dataclasses.replace(system, gap=gap)).contact_force)

    # At 0.3 m the contact is three nodes wide, and stays so over a millimetre.
    slope = (load(1e-3) - load(-1e-3)) / 2e-3
    np.testing.assert_allclose(jax.grad(load)(0.0), slope, rtol=1e-8)


def test_solve_static_presses_a_block_that_may_slide_uniformly():
    static = jc.solve_static(pressed_block())
    np.testing.assert_allclose(static.contact_pressure, 3.0, rtol=1e-9)


def test_solve_static_gives_the_peak_pressure_of_hertz_on_a_coarse_half_disc():
    # 1752 unknowns, 3 nodes in contact: the load is 2 % high, the peak pressure within 1 %.
    assert_hertz(15 / 24, load=3.877e6)


@pytest.mark.slow
def test_solve_static_gives_load_and_peak_pressure_of_hertz_on_6394_unknowns():
    assert_hertz(15 / 46, load=3.8237e6, linear_solver=jc.NestedDissection())


def assert_hertz(h, load, **solver):
    static = jc.solve_static(jc.discretize(jc.scenes.half_disc(h=h, gap=-0.08)), **solver)
    total = float(jnp.sum(static.contact_force))
    np.testing.assert_allclose(total, load, rtol=2e-3)
    hertz = jc.reference.Hertz(young=1e8, poisson=0.3, radius=15.0, load=total)
    np.testing.assert_allclose(jnp.max(static.contact_pressure), hertz.peak_pressure(), rtol=0.015)
