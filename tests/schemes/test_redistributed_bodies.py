"""RedistributedMass between two bodies: force, momentum, ledger, moments of each body."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.two_bodies import rigid_motions, rotation, round_bodies, stacked, thrown, touching

import jaxcontact as jc
from jaxcontact.schemes.mass_redistribution import (
    along_directions,
    contact_directions,
    redistribute,
)

# The dense inverse compiles fastest.
OPTIONS = {"scheme": jc.RedistributedMass(), "linear_solver": jc.Dense()}
# Momentum and energy: some hundred steps of some hundred sums.
KEPT = 1e-12
SPEED = 0.1


def momenta(stepper, motion):
    """Momenta and angular momenta of every state but the first, (T, k)

    Those of the redistributed mass. Viscous forces on massless rows are taken at the middle of a
    step, elastic and contact forces at its end: what they differ by belongs to the momentum.
    """
    system, mass = stepper.system, stepper.operators.mass
    fields = jax.vmap(system.restrict)(rigid_motions(np.asarray(system.points)))
    velocity = jax.vmap(system.restrict)(motion.velocity[1:])
    kept = jnp.einsum("ki,ti->tk", jax.vmap(lambda x: mass @ x)(fields), velocity)
    if system.viscosity is None:
        return np.asarray(kept)
    directions = contact_directions(system)
    increment = jax.vmap(system.restrict)(jnp.diff(motion.displacement, axis=0))

    def pull(field):
        force = system.viscosity @ along_directions(directions, field)
        return force - along_directions(directions, force)

    return np.asarray(kept - 0.5 * jnp.einsum("ki,ti->tk", jax.vmap(pull)(fields), increment))


def bars(n, courant, phase):
    """The first bar comes after a number of steps and a phase of one"""
    dt = courant / n
    scene = jc.scenes.bars(1, h=1.0 / n, gap=(2.0 + phase) * SPEED * dt)
    stepper = jc.prepare(jc.discretize(scene), dt, **OPTIONS)
    steps = round(2.0 / dt) + 10
    return stepper, jc.simulate(stepper, steps=steps, initial=thrown(scene, "bar0", [SPEED]))


@pytest.mark.parametrize("courant", [0.5, 1.0])
def test_bars_press_without_wiggles(courant):
    # The exact force is rho c v0 / 2 for two travel times of a wave through a bar.
    pressure, n, wiggles = 0.5 * SPEED, 100, []
    for phase in np.arange(8) / 8:
        stepper, motion = bars(n, courant, phase)
        force = np.asarray(motion.contact_force)[:, 0]
        during = force[round(0.5 * n / courant) : round(1.5 * n / courant)]
        wiggles.append(np.ptp(during) / pressure)
        momentum = momenta(stepper, motion)[:, 0]
        assert np.max(np.abs(momentum - SPEED)) < KEPT * SPEED
        ledger = jc.energy(stepper, motion)
        assert np.max(np.abs(ledger.residual)) < KEPT * ledger.total[0]
    assert max(wiggles) < 5e-4


def round_scene(d, viscosity=0.0):
    material = jc.KelvinVoigt(young=1.0, poisson=0.3, shear_viscosity=viscosity)
    mesh = round_bodies(3)
    if d == 2:
        ball, floor = jc.meshes.disc(1.0, h=0.4), jc.meshes.disc(1.5, h=0.5)
        floor = floor.moved(rotation=rotation(2, np.pi))
        mesh = jc.join({"ball": ball.moved(translation=[0.2, 2.55]), "floor": floor})
    return touching(mesh, "ball/contact", "floor/contact", material=material)


@pytest.mark.parametrize("viscosity", [0.0, 0.02], ids=["elastic", "viscous"])
@pytest.mark.parametrize("d", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_round_bodies_keep_their_momentum_and_the_ledger(d, viscosity):
    scene = round_scene(d, viscosity)
    stepper = jc.prepare(jc.discretize(scene), 0.05, **OPTIONS)
    initial = thrown(scene, "ball", [0.02, *[0.0] * (d - 2), -0.1])
    motion = jc.simulate(stepper, steps=100, initial=initial)
    assert 10 < np.count_nonzero(np.any(motion.active, axis=1)) < 90
    ledger = jc.energy(stepper, motion)
    assert np.max(np.abs(ledger.residual)) < KEPT * ledger.total[0]
    # Directions differ from node to node, so that forces have parts along inert directions too.
    directions = np.asarray(contact_directions(stepper.system))
    assert np.ptp(np.abs(directions[np.any(directions != 0.0, axis=1), 0])) > 0.1
    kept = momenta(stepper, motion)
    assert np.max(np.abs(kept - kept[0])) < KEPT * np.max(np.abs(kept[0]))


@pytest.mark.parametrize("d", [1, 2, 3])
def test_redistributed_mass_keeps_the_moments_of_both_bodies(d):
    scene = touching(stacked(1 / 4, 1 / 5, d)) if d < 3 else round_scene(3)
    system = jc.discretize(scene)
    moved = redistribute(system).to_symmetric(system.n_nodes).to_scipy()
    mass = system.mass.expand().to_scipy()
    x = np.asarray(system.points)
    motions = np.asarray(rigid_motions(x))
    if d == 1:
        motions = np.concatenate([motions, x[None]])
    bodies = scene.mesh.components()
    assert bodies.max() == 1
    for body in (0, 1):
        fields = np.where((bodies == body)[None, :, None], motions, 0.0).reshape(len(motions), -1)
        before, after = (fields @ (matrix @ fields.T) for matrix in (mass, moved))
        np.testing.assert_allclose(after, before, atol=KEPT * np.max(np.abs(before)))
    directions = np.asarray(contact_directions(system))
    assert np.count_nonzero(np.any(directions != 0.0, axis=1)) > len(system.contact_nodes)
    normal = moved @ np.diag(directions.reshape(-1))
    inertia = normal.reshape(moved.shape[0], -1, d).sum(axis=2)
    np.testing.assert_allclose(inertia, 0.0, atol=KEPT * np.max(mass.toarray()))


def test_mirrored_bodies_move_as_one_on_a_plane():
    h, steps, dt = jc.scenes.RADIUS / 4, 150, 5e-5
    one, two = (
        jc.discretize(scene(h)) for scene in (jc.scenes.half_disc, jc.scenes.two_half_discs)
    )
    down = jnp.broadcast_to(jnp.array([0.0, -1e6]), (steps, one.n_nodes, 2))
    alone = jc.simulate(jc.prepare(one, dt, **OPTIONS), down)
    both = jc.simulate(jc.prepare(two, dt, **OPTIONS), jnp.concatenate([down, -down], axis=1))
    assert np.count_nonzero(np.any(alone.active, axis=1)) > 40
    size = np.max(np.abs(alone.displacement))
    upper = both.displacement[:, : one.n_nodes]
    np.testing.assert_allclose(upper, alone.displacement, atol=KEPT * size)
    largest = np.max(alone.contact_impulse)
    np.testing.assert_allclose(both.contact_impulse, alone.contact_impulse, atol=KEPT * largest)


ROUND = round_scene(2, 0.02)


@jax.jit
def cost(values):
    young, points, control = values
    material = jc.KelvinVoigt(young=young, poisson=0.3, shear_viscosity=0.02)
    scene = jc.Scene(ROUND.mesh.with_points(points), material, contact=ROUND.contact)
    stepper = jc.prepare(jc.discretize(scene), 0.05, **OPTIONS)
    initial = thrown(ROUND, "ball", [0.02, -0.1])
    motion = jc.simulate(stepper, control, initial=initial)
    return jnp.sum(motion.final.displacement**2) + jnp.sum(motion.contact_impulse**2)


@pytest.mark.slow
def test_gradient_across_two_bodies_is_the_difference_quotient():
    rng = np.random.default_rng(4)
    control = jnp.asarray(0.01 * rng.normal(size=(30, ROUND.mesh.n_nodes, 2)))
    values = (jnp.asarray(1.0), jnp.asarray(ROUND.mesh.points), control)
    gradient = jax.jit(jax.grad(cost))(values)
    for k, value in enumerate(values):
        direction = jnp.asarray(rng.choice([-1.0, 1.0], size=value.shape))
        step = 1e-5 * float(jnp.max(jnp.abs(value)))

        def moved(sign, k=k, value=value, direction=direction, step=step):
            changed = value + sign * step * direction
            return cost((*values[:k], changed, *values[k + 1 :]))

        quotient = (moved(1.0) - moved(-1.0)) / (2.0 * step)
        np.testing.assert_allclose(jnp.vdot(gradient[k], direction), quotient, rtol=1e-5)


def test_node_of_two_pairs_is_refused():
    # The corner of the block meets the disc above it and the wall beside it.
    mesh = jc.join({"a": jc.meshes.rectangle((1.0, 1.0), h=0.5), "b": jc.meshes.disc(1.0, h=0.5)})
    mesh = mesh.with_points(mesh.points + np.where(mesh.components()[:, None] == 1, [0.5, 2.1], 0))
    low = mesh.with_set("b/low", lambda x, n: (n[:, 1] < -0.5) & (x[:, 1] > 1.0))
    contact = {"b/low": jc.Facets("a/top"), "a/right": jc.HalfSpace([2.0, 0.0], [-1.0, 0.0])}
    scene = jc.Scene(low, jc.KelvinVoigt(young=1.0, poisson=0.3), contact=contact)
    with pytest.raises(ValueError, match="more than one contact pair"):
        jc.prepare(jc.discretize(scene), 0.05, **OPTIONS)
