"""Random scenes, drawn from seeds; `fuzz` runs them.

A *kind* is what a program is compiled for: topology, obstacles, scheme, solvers, precision. A
*case* is a kind with values: sizes, material, poses, loads, a start and a direction to
differentiate along.
"""

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc
from jaxcontact.scene.cells import cell_volumes
from support.bodies import SCHEMES

STEPS = 6

MESHES = {
    1: jc.meshes.interval(1.0, h=0.2),
    2: jc.meshes.rectangle((1.0, 0.5), h=0.25),
    3: jc.meshes.box((1.0, 1.0, 1.0), h=0.5),
}
#: One layer of cells: with contact all around, every node is a contact node.
LAYERS = {
    1: jc.meshes.interval(1.0, h=1.0),
    2: jc.meshes.rectangle((1.0, 0.25), h=0.25),
    3: jc.meshes.box((1.0, 1.0, 0.5), h=0.5),
}
SIDES = {
    1: ("left", "right"),
    2: ("bottom", "top", "left", "right"),
    3: ("bottom", "top", "left", "right", "front", "back"),
}
#: Facet sets with their obstacles. `floor` is a second name of the first set.
ONE_PAIR_PER_NODE = ("plane", "ball", "opposite")
#: Conjugate gradients need pairs that lean on each other by no more than some per mille.
INDEPENDENT = (*ONE_PAIR_PER_NODE, "corner")
ARRANGEMENTS = (*INDEPENDENT, "twins", "around")


@dataclass(frozen=True)
class Kind:
    """Everything that is not a value"""

    dimension: int
    arrangement: str
    is_clamped: bool
    is_viscous: bool
    scheme: jc.ContactImplicit | Any
    linear_solver: jc.Dense | Any
    contact_solver: str
    precision: str

    @property
    def dtype(self):
        return jnp.dtype(self.precision)

    @property
    def is_iterative(self):
        return isinstance(self.linear_solver, jc.ConjugateGradient)

    @property
    def obstacles(self):
        """Facet set and class of every obstacle"""
        first, second, *others = SIDES[self.dimension]
        third = others[0] if others else second
        return {
            "plane": ((first, jc.HalfSpace),),
            "ball": ((first, jc.Ball),),
            "opposite": ((first, jc.HalfSpace), (second, jc.Ball)),
            "corner": ((first, jc.HalfSpace), (third, jc.HalfSpace)),
            "twins": ((first, jc.HalfSpace), ("floor", jc.HalfSpace)),
            "around": tuple((side, jc.HalfSpace) for side in SIDES[self.dimension]),
        }[self.arrangement]

    @property
    def clamped(self):
        return (SIDES[self.dimension][1],) if self.is_clamped else ()


@cache
def mesh_of(dimension, is_layer):
    mesh = (LAYERS if is_layer else MESHES)[dimension]
    return replace(mesh, facets=mesh.facets | {"floor": mesh.facets[SIDES[dimension][0]]})


def draw_kind(number):
    """The kind of a number: all dimensions and schemes in turn, the rest at random"""
    rng = np.random.default_rng([1, number])
    dimension, scheme = 1 + number % 3, SCHEMES[number % 5]
    solvers = [jc.Dense(), jc.NestedDissection(leaf_size=8), jc.ConjugateGradient()]
    linear_solver = solvers[number // 3 % 3]
    is_cg = isinstance(linear_solver, jc.ConjugateGradient)
    arrangements = INDEPENDENT if is_cg else ARRANGEMENTS
    if isinstance(scheme, jc.RedistributedMass):
        arrangements = ONE_PAIR_PER_NODE
    arrangement = str(rng.choice(arrangements))
    return Kind(
        dimension=dimension,
        arrangement=arrangement,
        is_clamped=arrangement in ("plane", "ball", "twins") and bool(rng.random() < 0.4),
        is_viscous=bool(rng.random() < 0.5),
        scheme=scheme,
        linear_solver=linear_solver,
        contact_solver="newton" if is_cg else ("newton", "gauss_seidel", "relaxed")[number % 7 % 3],
        precision="float32" if number % 4 == 3 else "float64",
    )


def draw(kind, seed):
    """Values of a kind and a direction in their space, as two pytrees of NumPy arrays"""
    rng = np.random.default_rng([2, seed])
    d, mesh = kind.dimension, mesh_of(kind.dimension, kind.arrangement == "around")
    power = lambda low, high: 10.0 ** rng.uniform(low, high)  # noqa: E731
    length, density, young = power(-2, 1), power(0, 4), power(0, 11)
    points = length * _shape(rng, mesh, isinstance(kind.scheme, jc.RedistributedMass))
    body = points - points.mean(axis=0)
    size = np.abs(body).max()
    cell = length / 4
    speed_of_sound = np.sqrt(young / density)
    dt = power(-2, 1.5) * cell / speed_of_sound
    start = str(rng.choice(["rest", "pressed", "fall", "fall", "graze", "far", "noise"]))
    gap = 0.0 if start in ("rest", "pressed") else size * power(-4, -1)
    is_flat = rng.random() < 0.5 or start == "graze"
    obstacles, toward = {}, None
    for name, surface in kind.obstacles:
        nodes = points[np.unique(mesh.facets[name])]
        if name == "floor":
            normal = obstacles[kind.obstacles[0][0]]["normal"]
            normal = normal + rng.choice([0.0, 0.0, power(-12, -2)]) * rng.normal(size=d)
        else:
            normal = _inward(rng, nodes, points, is_flat)
        toward = -normal if toward is None else toward
        own_gap = gap if rng.random() < 0.7 else gap * rng.uniform(1.0, 3.0)
        unit = normal / np.linalg.norm(normal)
        obstacles[name] = _touching(rng, surface, nodes, unit, own_gap, size)
    strength = power(-6, -2) * young / length  # a volume force by its static strain
    weight = strength * toward if start in ("rest", "pressed", "fall", "noise") else 0.0 * toward
    steps_to_touch = int(rng.integers(1, 4))
    speed = {"rest": 0.0, "pressed": size * power(-4, -1) / dt}.get(
        start, gap / (dt * steps_to_touch)
    )
    speed = 0.0 if start == "far" else speed
    fields = rng.normal(size=(2, *points.shape)) if start == "noise" else np.zeros((2, *body.shape))
    free = np.ones((mesh.n_nodes, 1))
    for name in kind.clamped:
        free[np.unique(mesh.facets[name])] = 0.0
    has_control = start != "graze" and rng.random() < 0.7
    control = rng.normal(size=(STEPS, *points.shape)) * has_control
    reach = speed * dt * STEPS + min(
        strength / density * (STEPS * dt) ** 2, strength * length**2 / young
    )
    viscosity = young * cell / speed_of_sound * power(-4, 0.5) * kind.is_viscous
    values = {
        "young": young,
        "poisson": rng.choice([rng.uniform(0.0, 0.45), -0.4, 0.49]),
        "bulk": viscosity * rng.uniform(0.5, 2.0),
        "shear": viscosity,
        "density": density,
        "points": points,
        "obstacles": obstacles,
        "body_force": weight,
        "dt": dt,
        "control": strength * control,
        "displacement": free * 0.2 * gap * np.tanh(fields[0]) / np.sqrt(d),
        "velocity": free * (speed * toward + 0.3 * speed * fields[1]),
    }
    values = jax.tree.map(lambda x: np.asarray(x, float), values)
    direction = jax.tree.map(lambda x: x * rng.normal(size=x.shape), values)
    # A body that touches cannot go on touching where poses and positions change at random.
    is_touching = gap == 0.0
    direction["points"] = 0.0 * points if is_touching else 0.1 * gap * rng.normal(size=points.shape)
    moves = rng.random() < 0.5 and not is_touching
    direction["obstacles"] = jax.tree.map(
        lambda x: moves * 0.1 * gap * rng.normal(size=x.shape), values["obstacles"]
    )
    travel = reach + gap + 1e-4 * length
    fixed = {
        "length": travel,
        "time": dt,
        "impulse": density * length**d * travel / dt,
        "weights": rng.normal(size=(3, *points.shape)),
        "kappa": power(-8, -2) * density * length**d * (reach / dt + 1e-6 * speed_of_sound) ** 2,
    }
    return values, direction, jax.tree.map(lambda x: np.asarray(x, float), fixed)


def _shape(rng, mesh, is_mild):
    """Node positions of size one: stretched, sheared, turned, with slivers

    Mild is by less than ten: the moments of a redistributed mass are of fourth order in it.
    """
    d = mesh.dimension
    points = mesh.points.copy()
    choice = rng.random()
    if choice < 0.25:
        points[:, rng.integers(d)] *= 10.0 ** rng.uniform(-1 if is_mild else -3, 0)
    elif choice < 0.5:
        for _ in range(5):
            first, second = rng.permutation(mesh.cells[rng.integers(mesh.n_cells)])[:2]
            share = 10.0 ** rng.uniform(-1 if is_mild else -4, -0.5)
            moved = points.copy()
            moved[first] = share * points[first] + (1.0 - share) * points[second]
            if np.all(cell_volumes(moved, mesh.cells) > 0.0):
                points = moved
                break
    if d > 1:
        points = points @ (np.eye(d) + 0.2 * np.triu(rng.normal(size=(d, d)), 1))
        if rng.random() < 0.7:
            turn, _ = np.linalg.qr(rng.normal(size=(d, d)))
            turn[:, 0] *= np.sign(np.linalg.det(turn))
            points = points @ turn.T
    return points + rng.choice([0.0, 10.0]) * rng.normal(size=d)


def _inward(rng, nodes, points, is_flat):
    """The inner normal of a side of the body, or one tilted by up to about 45 degrees"""
    inward = points.mean(axis=0) - nodes.mean(axis=0)
    if len(nodes) > 1:
        normal = np.linalg.svd(nodes - nodes.mean(axis=0))[2][-1]
        inward = normal * np.sign(normal @ inward)
    inward = inward / np.linalg.norm(inward)
    return inward if is_flat else inward + rng.uniform(-0.5, 0.5, size=inward.shape)


def _touching(rng, surface, nodes, normal, gap, size):
    """The obstacle at the distance of the gap from its nearest node"""
    if surface is jc.HalfSpace:
        nearest = nodes[np.argmin(nodes @ normal)]
        return {"point": nearest - gap * normal, "normal": normal * 10.0 ** rng.uniform(-1, 1)}
    middle = nodes.mean(axis=0)
    extent = np.abs(nodes - middle).max() + gap + 0.1 * size
    radius = extent * 10.0 ** rng.uniform(-0.5, 1.5)
    low, high = 0.0, radius + 4.0 * extent
    for _ in range(80):
        shift = 0.5 * (low + high)
        distance = np.linalg.norm(nodes - (middle - shift * normal), axis=1).min() - radius
        low, high = (shift, high) if distance < gap else (low, shift)
    return {"center": middle - high * normal, "radius": radius}
