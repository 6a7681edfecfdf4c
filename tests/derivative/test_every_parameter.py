"""Gradients by everything in a scene, through discretize, prepare and simulate, under jit."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.thrown_bodies import DT, MESHES, compiled, motion, parameters

import jaxcontact as jc

#: Taylor remainders fall by 4 +- 7 % per halved step: order 2 +- 0.1.
ORDER = 0.1
#: Error of central differences, beside their rounding: third derivatives at the step 1e-5.
DIFFERENCE = 1e-6
#: Rounding of the cost, of about a thousand additions, relative to its size.
ROUNDING = 64 * np.finfo(float).eps

CONTACT_IMPLICIT = [(1, "plane"), (2, "plane"), (2, "ball"), (3, "plane"), (3, "ball")]
SCHEMES = [jc.ContactStabilized(), jc.RedistributedMass(), jc.BackwardEuler(), jc.Trapezoidal()]


def check_every_parameter(dimension, scheme, obstacle):
    values, value, gradient = compiled(dimension, scheme, obstacle)
    leaves, structure = jax.tree.flatten(values)
    paths = jax.tree_util.tree_flatten_with_path(values)[0]
    rng = np.random.default_rng(0)
    base = float(value(values))
    for i, ((path, leaf), slope) in enumerate(zip(paths, jax.tree.leaves(gradient), strict=True)):
        name = jax.tree_util.keystr(path)
        size = max(float(jnp.max(jnp.abs(leaf))), 1e-2)
        direction = jnp.asarray(size * rng.choice([-1.0, 1.0], size=leaf.shape))
        if name in ("['points']", "['obstacle']['center']", "['obstacle']['radius']"):
            # Lengths, to be compared with the gap and not with the size of the body.
            direction = 0.02 * direction

        def at(h, i=i, direction=direction):
            return float(
                value(
                    jax.tree.unflatten(
                        structure, [*leaves[:i], leaves[i] + h * direction, *leaves[i + 1 :]]
                    )
                )
            )

        derivative = float(jnp.vdot(slope, direction))
        assert np.isfinite(derivative), name
        h = 1e-5
        central = (at(h) - at(-h)) / (2 * h)
        bound = DIFFERENCE * abs(derivative) + ROUNDING * abs(base) / h
        assert abs(central - derivative) <= bound, (name, central, derivative)

        # Large steps may cross a kink, small ones drown in rounding: look just above rounding.
        steps = 4e-4 * 0.5 ** np.arange(11)
        remainders = np.array([abs(at(h) - base - h * derivative) for h in steps])
        # Trapezoidal amplifies rounding at contact.
        amplification = 80 if isinstance(scheme, jc.Trapezoidal) else 20
        floor = amplification * ROUNDING * max(abs(base), abs(derivative))
        usable = remainders[: int(np.argmax(np.append(remainders <= floor, True)))]
        is_cut = usable.size < steps.size
        if usable.size < 3 or (is_cut and usable[-1] > 16 * floor):
            continue  # affine along this parameter, up to the next kink
        orders = np.log2(usable[:-1] / usable[1:])[-2:]
        assert np.all(np.abs(orders - 2.0) <= ORDER), (name, orders)


@pytest.mark.parametrize(("dimension", "obstacle"), CONTACT_IMPLICIT)
def test_gradient_by_every_parameter_is_exact(dimension, obstacle):
    values = parameters(dimension, obstacle)
    assert np.any(np.asarray(motion(dimension, values).strong)), "no contact, no claim"
    check_every_parameter(dimension, None, obstacle)


@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=lambda s: type(s).__name__)
def test_gradient_by_every_parameter_is_exact_for_other_schemes(scheme):
    check_every_parameter(2, scheme, "plane")


@pytest.mark.slow
@pytest.mark.parametrize("scheme", SCHEMES[2:], ids=lambda s: type(s).__name__)
def test_gradient_by_every_parameter_is_exact_for_every_scheme(scheme):
    check_every_parameter(2, scheme, "plane")


@pytest.mark.slow
@pytest.mark.parametrize("dimension", [1, 3])
@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: type(s).__name__)
def test_gradient_by_every_parameter_is_exact_for_every_scheme_in_1d_and_3d(scheme, dimension):
    check_every_parameter(dimension, scheme, "plane")


def test_gradient_by_the_normal_in_1d_is_zero():
    # Only its direction counts.
    _, _, gradient = compiled(1)
    np.testing.assert_allclose(gradient["obstacle"]["normal"], 0.0, atol=1e-12)


def test_gradient_by_materials_of_regions_adds_up_to_that_of_one_material():
    base = MESHES[2]
    halves = {
        "left": np.arange(base.n_cells // 2),
        "right": np.arange(base.n_cells // 2, base.n_cells),
    }
    facets = {name: np.asarray(f) for name, f in base.facets.items()}
    mesh = jc.Mesh.from_arrays(base.points, base.cells, facets, halves)

    def impulse(material):
        scene = jc.Scene(
            mesh,
            material,
            contact={"bottom": jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.0, 1.0]))},
        )
        stepper = jc.prepare(jc.discretize(scene), DT)
        fall = jnp.broadcast_to(jnp.array([0.0, -1.0]), mesh.points.shape)
        start = jc.State(jnp.zeros_like(fall), fall)
        return jnp.sum(jc.simulate(stepper, steps=10, initial=start).contact_impulse ** 2)

    one = jc.KelvinVoigt(young=100.0, poisson=0.3)
    total = jax.grad(impulse)(one)
    parts = jax.grad(impulse)({"left": one, "right": one})
    np.testing.assert_allclose(parts["left"].young + parts["right"].young, total.young, rtol=1e-10)
    np.testing.assert_allclose(
        parts["left"].density + parts["right"].density, total.density, rtol=1e-10
    )
