"""Nested dissection gives the motion and the gradient of the dense inverse where it is hard."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.contact import Status

#: Both factors are backward stable; contact keeps what the conditioning of a step leaves.
AGREEMENT = 1e-9
SOLVERS = {"dissection": jc.NestedDissection(leaf_size=8), "dense": jc.Dense()}
STEPS = 20


def thrown(scene, dt, push):
    """A body with a held side, thrown so as to touch in the third step and pushed [N/m^2]."""
    system = jc.discretize(scene)
    top = jnp.max(system.points[:, 1])
    speed = float(jnp.min(system.gap)) / (2.5 * dt)
    depth = (top - system.points[:, 1]) / (top - jnp.min(system.points[:, 1]))
    velocity = jnp.zeros_like(system.points).at[:, 1].set(-speed * depth)
    control = jnp.zeros((STEPS, *velocity.shape)).at[:, :, 1].set(-push)
    return system, control, jc.State(jnp.zeros_like(velocity), velocity)


def paper(dt):
    return thrown(jc.scenes.half_disc(h=15 / 6, gap=0.01), dt, push=1e7)


def slivers(dt):
    """Cells of aspect 1e3 in layers whose stiffness jumps by 1e4"""
    flat = jc.meshes.rectangle((8.0, 8.0), h=1.0 + 1e-9)
    points = np.asarray(flat.points) * [1.0, 1e-3]
    layer = points[np.asarray(flat.cells)].mean(axis=1)[:, 1] // 2e-3 % 2
    mesh = jc.Mesh.from_arrays(
        points,
        flat.cells,
        flat.facets,
        regions={"soft": np.flatnonzero(layer == 0), "stiff": np.flatnonzero(layer == 1)},
    )
    material = {
        "soft": jc.KelvinVoigt(young=1e4, poisson=0.3),
        "stiff": jc.KelvinVoigt(young=1e8, poisson=0.3),
    }
    plane = jc.HalfSpace([0.0, -1e-4], [0.0, 1.0])
    scene = jc.Scene(mesh, material, clamped=("top",), contact={"bottom": plane})
    return thrown(scene, dt, push=1e6)


@pytest.mark.parametrize(
    ("scene", "dt"),
    [
        pytest.param(paper, 1e-7, marks=pytest.mark.slow),
        pytest.param(paper, 5e-5, marks=pytest.mark.slow),
        pytest.param(paper, 1e-3, marks=pytest.mark.slow),
        (paper, 1e-2),
        pytest.param(slivers, 1e-7, marks=pytest.mark.slow),
        (slivers, 1e-5),
    ],
)
def test_nested_dissection_moves_as_the_dense_inverse(scene, dt):
    system, control, initial = scene(dt)
    scale = jnp.max(jnp.abs(initial.velocity)) * dt

    def run(control, solver):
        stepper = jc.prepare(system, dt, linear_solver=solver)
        trajectory = jc.simulate(stepper, control, initial=initial)
        return jnp.sum((trajectory.displacement / scale) ** 2), trajectory

    found = {
        name: jax.value_and_grad(run, has_aux=True)(control, solver)
        for name, solver in SOLVERS.items()
    }
    ((_, ours), our_slope), ((_, dense), dense_slope) = found["dissection"], found["dense"]
    assert np.any(ours.active)
    np.testing.assert_array_equal(ours.active, dense.active)
    assert np.all(ours.status == Status.CONVERGED)
    assert np.max(ours.residual) < 1e-11
    for mine, other in (
        (ours.displacement, dense.displacement),
        (ours.contact_impulse, dense.contact_impulse),
        (our_slope, dense_slope),
    ):
        assert np.max(np.abs(mine - other)) < AGREEMENT * np.max(np.abs(other))
