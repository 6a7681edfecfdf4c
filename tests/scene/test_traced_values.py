"""A value that is out of range gives NaN where it is traced and a check cannot raise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import BLOCK, DT

import jaxcontact as jc

POINTS = jnp.asarray(BLOCK.points)
GOOD = {
    "young": 100.0,
    "poisson": 0.3,
    "bulk_viscosity": 0.2,
    "shear_viscosity": 0.1,
    "density": 1.0,
    "radius": 1.0,
    "slope": 1.0,
    "points": POINTS,
}
BAD = {
    "negative young": {"young": -1.0},
    "zero young": {"young": 0.0},
    "infinite young": {"young": jnp.inf},
    "poisson above": {"poisson": 0.5},
    "poisson below": {"poisson": -1.0},
    "negative bulk viscosity": {"bulk_viscosity": -1e-3},
    "negative shear viscosity": {"shear_viscosity": -1e-3},
    "negative density": {"density": -1.0},
    "negative radius": {"radius": -1.0},
    "slope of seven": {"slope": 7.0},
    "mirrored mesh": {"points": POINTS * jnp.array([[-1.0, 1.0]])},
}


def motion(values):
    """Displacements (4, N, 2) of a block that falls, far from a disc and from a wall"""
    values = dict(values)
    mesh = BLOCK.with_points(values.pop("points"))
    disc = jc.Ball(np.array([1.0, -2.0]), values.pop("radius"))
    wall = jc.SignedDistance(lambda x, slope: slope * (x[0] + 5.0), values.pop("slope"))
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(**values),
        contact={"bottom": disc, "left": wall},
        body_force=jnp.array([0.0, -1.0]),
    )
    return jc.simulate(jc.prepare(jc.discretize(scene), DT), steps=4).displacement[1:]


def with_bad(name):
    return jax.tree.map(jnp.asarray, GOOD | BAD[name])


@pytest.fixture(scope="module")
def compiled():
    def total(values):
        return jnp.sum(motion(values))

    return jax.jit(motion), jax.jit(jax.grad(total))


def test_values_in_range_give_numbers(compiled):
    run, gradient = compiled
    values = jax.tree.map(jnp.asarray, GOOD)
    np.testing.assert_allclose(run(values), motion(GOOD), atol=1e-13)
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(gradient(values)))


@pytest.mark.parametrize("name", BAD)
def test_value_out_of_range_gives_nan_under_jit(compiled, name):
    assert np.all(np.isnan(compiled[0](with_bad(name))))


@pytest.mark.parametrize("name", BAD)
def test_value_out_of_range_gives_nan_under_grad(compiled, name):
    gradient = compiled[1](with_bad(name))
    assert all(np.all(np.isnan(gradient[key])) for key in ("young", "density", "points"))


def test_value_out_of_range_spoils_its_lane_of_a_batch_only():
    names = [name for name in BAD if "points" not in BAD[name]]
    lanes = [jax.tree.map(jnp.asarray, GOOD), *map(with_bad, names)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *lanes)
    is_nan = np.isnan(jax.jit(jax.vmap(motion))(batch)).all(axis=(1, 2, 3))
    np.testing.assert_array_equal(is_nan, [False] + [True] * len(names))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"young": -1.0}, "young must be positive"),
        ({"slope": 7.0}, r"length 7 at a contact node.*divide the function by"),
        ({"radius": -1.0}, "radius must be positive"),
    ],
)
def test_concrete_value_out_of_range_is_named_under_jit_too(changes, message):
    @jax.jit
    def run(density):
        return motion(GOOD | changes | {"density": density})

    with pytest.raises(ValueError, match=message):
        run(1.0)
