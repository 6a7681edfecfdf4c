"""Claims about matrix products: in float32 none is rounded to TF32 or bfloat16, on any device.

What a GPU does with a product is in its precision attribute, which programs lowered on a CPU show.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support.bodies import SCHEMES

import jaxcontact as jc
from jaxcontact.linear.dissection.nested_dissection import NestedDissection

SOLVERS = {
    "dissection": NestedDissection(),
    "dense": jc.Dense(),
    "cg": jc.ConjugateGradient(),
}
STEPS = 4


def coarse_products(function, *arguments):
    """Return the number of matrix products in the lowered program and those not exact."""
    text = jax.jit(function).lower(*arguments).as_text()
    products = re.findall(r"stablehlo\.dot_general.*", text)
    return len(products), [line for line in products if "HIGHEST, HIGHEST" not in line]


def block(young=1.0):
    mesh = jc.meshes.rectangle((1.0, 1.0), h=0.125)
    material = jc.KelvinVoigt(young=young, poisson=0.3, bulk_viscosity=0.01, shear_viscosity=0.01)
    floor = jc.HalfSpace(np.array([0.0, -0.01]), np.array([0.0, 1.0]))
    return jc.discretize(jc.Scene(mesh, material, contact={"bottom": floor}), dtype=jnp.float32)


def throw(stepper, control, **options):
    still = jnp.zeros_like(control[0])
    initial = jc.State(still, still.at[:, -1].set(-0.1))
    return jc.simulate(stepper, control, initial=initial, **options)


@pytest.fixture(scope="module")
def system():
    return block()


@pytest.fixture(scope="module")
def control(system):
    return jnp.zeros((STEPS, system.n_nodes, 2), jnp.float32)


@pytest.mark.parametrize("solver", SOLVERS)
def test_material_gradient_is_in_full_precision(control, solver):
    def cost(young, control):
        stepper = jc.prepare(block(young), 0.05, linear_solver=SOLVERS[solver])
        return jnp.sum(throw(stepper, control).displacement ** 2)

    gradient = jax.value_and_grad(cost, argnums=(0, 1))
    for program in (gradient, jax.vmap(gradient, in_axes=(0, None))):
        young = jnp.ones(2 if program is not gradient else (), jnp.float32)
        count, coarse = coarse_products(program, young, control)
        assert count > 5
        assert not coarse


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda scheme: type(scheme).__name__)
@pytest.mark.parametrize("weak_contact", [None, jc.CriticalCone()], ids=["reverse", "forward"])
def test_schemes_and_modes_are_in_full_precision(system, control, scheme, weak_contact):
    stepper = jc.prepare(system, 0.05, scheme=scheme)

    def motion(stepper, control):
        return throw(stepper, control, weak_contact=weak_contact).displacement

    def cost(stepper, control):
        return jnp.sum(motion(stepper, control) ** 2)

    def derivative(stepper, control):
        if weak_contact is None:
            return jax.grad(cost, argnums=1)(stepper, control)
        return jax.jvp(lambda u: motion(stepper, u), (control,), (control,))

    count, coarse = coarse_products(derivative, stepper, control)
    assert count > 5
    assert not coarse


def test_hessian_products_in_a_batch_are_in_full_precision(system, control):
    stepper = jc.prepare(system, 0.05, linear_solver=NestedDissection())

    def cost(control):
        return jnp.sum(throw(stepper, control, weak_contact=jc.ClosedBranch()).displacement ** 2)

    def product(u):
        return jax.jvp(jax.grad(cost), (u,), (u,))[1]

    count, coarse = coarse_products(jax.vmap(product), jnp.stack([control, control]))
    assert count > 5
    assert not coarse


def test_what_surrounds_a_simulation_is_in_full_precision(system, control):
    stepper = jc.prepare(system, 0.05)
    trajectory = throw(stepper, control)
    cost = jc.TrackingCost(
        system, dt=0.05, target=trajectory.displacement, control_weight=1.0, nodes=[0, 1]
    )
    reduced = jc.reduce(system, 6)

    programs = [
        (jc.energy, (stepper, trajectory, control)),
        (cost, (trajectory, control)),
        (jax.grad(lambda u: cost(trajectory, u)), (control,)),
        (lambda u: jc.l2_value_and_grad(jnp.sum, system, 0.05)(u), (control,)),
        (lambda u: throw(jc.prepare(reduced, 0.05), u), (control,)),
        (reduced.control_load, (control[0],)),
        (lambda x: reduced.stiffness @ x, (reduced.load,)),
    ]
    counts = []
    for function, arguments in programs:
        count, coarse = coarse_products(function, *arguments)
        counts.append(count)
        assert not coarse
    assert sum(count > 0 for count in counts) >= 5
