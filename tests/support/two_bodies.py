"""Scenes of two bodies that several test modules use."""

import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

RUBBER = jc.KelvinVoigt(young=1.0, poisson=0.3)


def rotation(d, angle):
    """The rotation of the first and the last axis by an angle (1D: the identity)"""
    matrix = np.eye(d)
    if d > 1:
        c, s = np.cos(angle), np.sin(angle)
        matrix[[0, 0, -1, -1], [0, -1, 0, -1]] = c, -s, s, c
    return matrix


def cube(d, h):
    """The unit cube in d dimensions, the last axis up"""
    if d == 1:
        return jc.meshes.interval(1.0, h=h)
    make = jc.meshes.rectangle if d == 2 else jc.meshes.box
    return make((1.0,) * d, h=h)


def stacked(h_lower, h_upper, d=2, *, gap=0.0, angle=0.0, jitter=0.0):
    """Two unit cubes on top of each other, nodes moved inside and along the faces by jitter h"""
    rng, bodies = np.random.default_rng(0), {}
    for name, h in (("lower", h_lower), ("upper", h_upper)):
        mesh = cube(d, h)
        x = mesh.points
        is_on_face = (x < 1e-9) | (x > 1.0 - 1e-9)
        moves = np.where(is_on_face, 0.0, rng.uniform(-1.0, 1.0, x.shape))
        bodies[name] = mesh.with_points(x + jitter * h * moves)
    bodies["upper"] = bodies["upper"].moved(translation=(1.0 + gap) * np.eye(d)[-1])
    return jc.join(bodies).moved(rotation=rotation(d, angle))


#: The faces that meet, in one dimension and in more.
FACES = {1: ("upper/left", "lower/right")} | dict.fromkeys((2, 3), ("upper/bottom", "lower/top"))


def touching(mesh, slave=None, master=None, *, along=None, material=RUBBER, **scene):
    """The scene of a `stacked` mesh, by default with the upper body as slave"""
    first, second = FACES[mesh.dimension]
    contact = {slave or first: jc.Facets(master or second, along)}
    return jc.Scene(mesh, material, contact=contact, **scene)


def round_bodies(d=2):
    """A disc or half ball above a larger one, both curved and of other meshes"""
    if d == 2:
        ball, floor = jc.meshes.disc(1.0, h=0.25), jc.meshes.disc(1.5, h=0.3)
    else:
        ball, floor = jc.meshes.half_ball(1.0, h=0.35), jc.meshes.half_ball(1.5, h=0.6)
        # About the vertical axis, so that no edges of the two lie on top of each other.
        ball = ball.moved(rotation=rotation(3, 0.3)[np.ix_([0, 2, 1], [0, 2, 1])])
    up = np.zeros(d)
    up[-1] = 2.6
    floor = floor.moved(rotation=rotation(d, np.pi))
    return jc.join({"ball": ball.moved(translation=up), "floor": floor})


def rigid_motions(points):
    """Translations and infinitesimal rotations at the points (N, d), (k, N, d)"""
    d = points.shape[1]
    fields = [np.broadcast_to(axis, points.shape) for axis in np.eye(d)]
    for i in range(d):
        for j in range(i):
            turn = np.zeros((d, d))
            turn[i, j], turn[j, i] = 1.0, -1.0
            fields.append(points @ turn)
    return jnp.asarray(np.stack(fields))


def thrown(scene, body, velocity):
    """The state in which one body of a joined mesh moves, and everything else rests"""
    nodes = np.unique(scene.mesh.cells[scene.mesh.regions[body]])
    rest = jnp.zeros(scene.mesh.points.shape)
    return jc.State(rest, rest.at[nodes].set(jnp.asarray(velocity)))


def momenta(system, motion, points):
    """Momenta and angular momenta of every state, (T+1, k)"""
    mass = system.mass.scalar.to_scipy()
    fields = np.asarray(rigid_motions(points))
    weighted = np.stack([mass @ field for field in fields])
    return np.einsum("kni,tni->tk", weighted, motion.velocity)
