"""A spinning, vibrating block that hits a tilted floor, as a function of all that it depends on."""

from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

MESHES = {
    2: jc.meshes.rectangle((1.0, 0.5), h=0.25),
    3: jc.meshes.box((1.0, 0.6, 0.4), h=0.3),
}
SIDES = {2: ("left", "right", "bottom", "top"), 3: (*jc.meshes.box((1.0,) * 3, h=1.0).facets,)}
SCHEMES = (jc.ContactImplicit(), jc.ContactStabilized(), jc.BackwardEuler())
STEPS = 60
DT = 1e-3


def rotation(dimension, angle=0.5):
    """A rotation in the plane of the first and the last axis, and in 3D about the first too"""
    c, s = np.cos(angle), np.sin(angle)
    turn = np.eye(dimension)
    turn[np.ix_((0, -1), (0, -1))] = [[c, -s], [s, c]]
    if dimension == 3:
        c, s = np.cos(0.3), np.sin(0.3)
        turn = np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]) @ turn
    return turn


def parameters(dimension, spin=6.0, speed=3.0, height=0.03, floor="plane"):
    """The body turned by `rotation`, its lowest corner at the height above a plane

    The top of a ball, or the bottom of a bowl, is at the origin of the plane.
    """
    mesh, rng = MESHES[dimension], np.random.default_rng(dimension)
    e, points = np.eye(dimension)[-1], np.asarray(mesh.points)
    x = (points - points.mean(axis=0)) @ rotation(dimension).T
    velocity = 0.05 * rng.normal(size=x.shape)
    velocity[:, 0] -= spin * x[:, -1]
    velocity[:, -1] += spin * x[:, 0] - speed
    x[:, -1] += height - x[:, -1].min()
    values = {
        "material": {
            "young": 1e6,
            "poisson": 0.3,
            "bulk_viscosity": 100.0,
            "shear_viscosity": 200.0,
            "density": 1000.0,
        },
        "floor": {
            "plane": {"point": 0.0 * e, "normal": e + 0.1 * rng.normal(size=dimension)},
            "ball": {"center": -3.0 * e, "radius": 3.0},
            "bowl": {"center": 3.0 * e, "radius": 3.0},
        }[floor],
        "points": points,
        "gravity": -9810.0 * e,
        "dt": DT,
        "control": 1e4 * rng.normal(size=(STEPS, *x.shape)),
        "displacement": x - points + 1e-4 * rng.normal(size=x.shape),
        "velocity": velocity,
    }
    return jax.tree.map(lambda x: jnp.asarray(x, jnp.float64), values)


def elastic(values):
    """The values without viscosity"""
    return values | {
        "material": values["material"] | {"bulk_viscosity": 0.0, "shear_viscosity": 0.0}
    }


@partial(jax.jit, static_argnames=("dimension", "scheme", "is_flight", "is_bowl", "dtype"))
def stepper_of(dimension, values, scheme=None, is_flight=False, is_bowl=False, dtype=jnp.float64):
    """The stepper of the block; in free flight without floor and weight"""
    is_round = "radius" in values["floor"]
    kind = partial(jc.Ball, inside=is_bowl) if is_round else jc.HalfSpace
    floor = kind(**values["floor"])
    scene = jc.Scene(
        MESHES[dimension].with_points(values["points"]),
        jc.KelvinVoigt(**values["material"]),
        contact={} if is_flight else dict.fromkeys(SIDES[dimension], floor),
        body_force=None if is_flight else values["gravity"],
        large_rotation=True,
    )
    return jc.prepare(jc.discretize(scene, dtype=dtype), values["dt"], scheme=scheme)


def initial_of(values):
    return jc.State(values["displacement"], values["velocity"])


@cache
def hit(dimension, scheme, floor="plane"):
    """Stepper, control and motion of the block that hits the floor with a corner"""
    values = parameters(dimension, floor=floor)
    stepper = stepper_of(dimension, values, scheme, is_bowl=floor == "bowl")
    motion = jc.simulate(stepper, values["control"], initial=initial_of(values))
    return stepper, values["control"], motion


@partial(jax.jit, static_argnames=("dimension", "scheme", "is_bowl"))
def cost(dimension, values, scheme, is_bowl=False):
    """A cost in which states, impulses and gaps enter"""
    stepper = stepper_of(dimension, values, scheme, is_bowl=is_bowl)
    motion = jc.simulate(stepper, values["control"], initial=initial_of(values))
    weight = jnp.linspace(1.0, 2.0, values["points"].size).reshape(values["points"].shape)
    return (
        jnp.sum(weight * motion.displacement[-1])
        + 0.1 * jnp.sum(weight * motion.velocity[-1])
        + 1e-4 * jnp.sum(motion.contact_impulse**2)
        + jnp.sum(jnp.sin(motion.gap[-1]))
        + jnp.sum(motion.rotation[-1, 0, 0])
    )
