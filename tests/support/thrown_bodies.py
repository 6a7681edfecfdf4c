"""A body thrown at an obstacle, as a function of everything that a scene is made of."""

from dataclasses import replace
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc
from support.bodies import SCHEMES

MESHES = {
    1: jc.meshes.interval(1.0, h=0.125),
    2: jc.meshes.rectangle((1.0, 0.5), h=0.25),
    3: jc.meshes.box((1.0, 1.0, 0.5), h=0.5),
}
SIDES = {1: ("left", "right"), 2: ("bottom", "top"), 3: ("bottom", "top")}
STEPS = 24
DT = 0.01


def up(dimension):
    return np.eye(dimension)[-1]


def parameters(dimension, obstacle="plane"):
    """Everything that the motion depends on, as a pytree of float64 arrays"""
    mesh, e = MESHES[dimension], up(dimension)
    rng = np.random.default_rng(dimension)
    shape = (mesh.n_nodes, dimension)
    if obstacle == "ball":
        # Its top is 0.06 below the middle of the body.
        middle = 0.5 * (mesh.points.max(axis=0) + mesh.points.min(axis=0))
        middle[-1] = 0.0
        surface = {"center": middle - 2.06 * e, "radius": 2.0}
    else:
        tilt = 0.04 * (np.arange(dimension) - (dimension - 1.0))
        surface = {"point": (0.0 if dimension == 1 else -0.09) * e - 0.03 * e, "normal": e + tilt}
    values = {
        "material": {
            "young": 100.0,
            "poisson": 0.3,
            "bulk_viscosity": 0.2,
            "shear_viscosity": 0.1,
            "density": 1.3,
        },
        "obstacle": surface,
        "points": np.array(mesh.points),
        "traction": -0.5 * e,
        "body_force": -1.0 * e,
        "dt": DT,
        "control": rng.normal(size=(STEPS, *shape)),
        "displacement": 1e-3 * rng.normal(size=shape),
        "velocity": -1.2 * e + 0.1 * rng.normal(size=shape),
    }
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), values)


def unloaded(dimension, gap, force=0.0, dt=DT, **material):
    """The values of a body at the distance gap from a plane, under a weight only"""
    e = up(dimension)
    usual = {"density": 1.0, "bulk_viscosity": 0.1, "shear_viscosity": 0.1}
    values = parameters(dimension)
    changes = {
        "material": values["material"] | usual | material,
        "obstacle": {"point": -gap * e, "normal": e},
        "traction": 0.0 * e,
        "body_force": -force * e,
        "dt": dt,
    }
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), values | changes)


@partial(jax.jit, static_argnames=("dimension", "scheme", "dtype"))
def stepper_of(dimension, values, scheme=None, dtype=jnp.float64):
    """The stepper, made in one program instead of a hundred small ones"""
    low, top = SIDES[dimension]
    obstacle = values["obstacle"]
    kind = jc.Ball if "radius" in obstacle else jc.HalfSpace
    scene = jc.Scene(
        MESHES[dimension].with_points(values["points"]),
        jc.KelvinVoigt(**values["material"]),
        contact={low: kind(**obstacle)},
        traction={top: values["traction"]},
        body_force=values["body_force"],
    )
    return jc.prepare(jc.discretize(scene, dtype=dtype), values["dt"], scheme=scheme)


def initial_of(values):
    return jc.State(values["displacement"], values["velocity"])


def motion(dimension, values, scheme=None):
    return jc.simulate(
        stepper_of(dimension, values, scheme), values["control"], initial=initial_of(values)
    )


@jax.jit
def cost(trajectory):
    """A cost in which everything enters: states at all times, the end, impulses and gaps"""
    final = trajectory.displacement[-1]
    weight = jnp.linspace(1.0, 2.0, final.size).reshape(final.shape)
    return (
        jnp.sum(weight * final)
        + 0.1 * jnp.sum(weight * trajectory.velocity[-1])
        + jnp.sum(trajectory.displacement**2)
        + 10.0 * jnp.sum(trajectory.contact_impulse**2)
        + jnp.sum(jnp.cos(trajectory.gap[-1]))
    )


@partial(jax.jit, static_argnames="weak_contact")
def value_and_gradient(stepper, control, initial, weak_contact=None):
    """The cost of a motion and its gradient by control and initial state"""

    def value(control, initial):
        return cost(jc.simulate(stepper, control, initial=initial, weak_contact=weak_contact))

    return jax.value_and_grad(value, (0, 1))(control, initial)


@cache
def thrown():
    """Stepper, control and initial state of the plane body: strong contact, and none is weak"""
    values = parameters(2)
    return stepper_of(2, values), values["control"], initial_of(values)


@cache
def grazing(dimension, scheme=SCHEMES[0]):
    """A motion with one weak contact: stepper, control, initial state, (step, pair)

    The body is slowed down and pushed back in free flight. The gap of every pair is set to the
    largest normal displacement of that flight, so that it touches once, without an impulse. With
    `ContactStabilized` it is the predictor y + dt v that touches, the body itself stays open.
    """
    e, values = up(dimension), unloaded(dimension, gap=10.0)
    shape = values["points"].shape
    rng = np.random.default_rng(dimension)
    control = jnp.asarray(12.0 * e + 0.3 * rng.normal(size=(STEPS, *shape)))
    initial = jc.State(jnp.zeros(shape), jnp.asarray(np.broadcast_to(-e, shape)))
    stepper = stepper_of(dimension, values, scheme)
    system = stepper.system
    flight = jc.simulate(stepper, control, initial=initial)
    reached = flight.displacement[1:]
    if isinstance(scheme, jc.ContactStabilized):
        reached = flight.displacement[:-1] + DT * flight.velocity[:-1]
    normal = np.asarray(jax.vmap(lambda y: system.normals @ y)(system.restrict(reached)))
    place = np.unravel_index(normal.argmax(), normal.shape)
    system = replace(system, gap=jnp.full(normal.shape[1], normal.max()))
    return replace(stepper, system=system), control, initial, place
