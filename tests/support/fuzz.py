"""Random scenes: drawn by `fuzz_draw`, run in batches of one kind, and judged by `fuzz_checks`."""

from dataclasses import dataclass
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc
from support.fuzz_draw import Kind, draw, draw_kind, mesh_of

__all__ = ["Batch", "Kind", "draw_kind", "run"]

#: Cases that run at once under vmap. In larger batches, LAPACK calls of one program can wait for
#: each other for ever in the thread pool of XLA (jaxlib 0.10.2, two cores).
LANES = 10
#: Step of the differences, relative to the values.
STEP = 1e-5


def stepper_of(kind, values, fixed):
    """The stepper; everything that may be traced is in the values"""
    viscosity = (
        {"bulk_viscosity": values["bulk"], "shear_viscosity": values["shear"]}
        if kind.is_viscous
        else {}
    )
    scene = jc.Scene(
        mesh_of(kind.dimension, kind.arrangement == "around").with_points(values["points"]),
        jc.KelvinVoigt(
            young=values["young"], poisson=values["poisson"], density=values["density"], **viscosity
        ),
        clamped=kind.clamped,
        contact={name: surface(**values["obstacles"][name]) for name, surface in kind.obstacles},
        body_force=values["body_force"],
    )
    solver = {
        "newton": jc.SemismoothNewton(),
        "gauss_seidel": jc.ProjectedGaussSeidel(max_sweeps=2000),
        "relaxed": jc.RelaxedContact(fixed["kappa"]),
    }[kind.contact_solver]
    return jc.prepare(
        jc.discretize(scene, dtype=kind.dtype),
        values["dt"],
        scheme=kind.scheme,
        linear_solver=kind.linear_solver,
        contact_solver=solver,
    )


def motion(kind, values, fixed):
    """Stepper and trajectory"""
    stepper = stepper_of(kind, values, fixed)
    initial = jc.State(values["displacement"], values["velocity"])
    return stepper, jc.simulate(stepper, values["control"], initial=initial)


def outcome(kind, values, direction, fixed):
    """Everything that is judged, of one case: matrices, motion, ledger, slope of a random cost"""

    def value(values):
        stepper, trajectory = motion(kind, values, fixed)
        system = stepper.system
        scale = {name: fixed[name].astype(kind.dtype) for name in ("length", "time", "impulse")}
        weights = fixed["weights"].astype(kind.dtype)
        place = trajectory.displacement / scale["length"]
        speed = trajectory.velocity[-1] * scale["time"] / scale["length"]
        # Of dependent pairs only the sum of their forces is known.
        impulse = jnp.sum(trajectory.contact_impulse, axis=0) / scale["impulse"]
        force = system.normals.transposed_product(impulse, system.size)
        cost = jnp.vdot(weights[0], place[-1]) + 0.5 * jnp.sum(place**2)
        cost += jnp.vdot(weights[1], speed) + jnp.vdot(system.restrict(weights[2]), force)
        return cost, (stepper, trajectory)

    grad = jax.value_and_grad(value, has_aux=True)
    (cost, (stepper, trajectory)), gradient = grad(values)
    products = jax.tree.map(lambda g, x: g * x, gradient, direction)
    system = stepper.system
    ledger = jc.energy(stepper, trajectory, values["control"])
    normals = jnp.zeros((system.normals.count, system.size), kind.dtype)
    rows = jnp.arange(system.normals.count)[:, None]
    return {
        "mass": stepper.operators.mass.expand().to_dense(),
        "stiffness": system.stiffness.to_dense(),
        "viscosity": 0.0 if system.viscosity is None else system.viscosity.to_dense(),
        "normals": normals.at[rows, system.normals.unknowns].add(system.normals.weights),
        "gap": system.gap,
        "start": system.restrict(values["displacement"]),
        "kappa": fixed["kappa"],
        "place": jnp.max(jnp.abs(values["points"])),
        "length": fixed["length"],
        "load": system.load[None, :]
        + jax.vmap(system.control_load)(values["control"].astype(kind.dtype)),
        "dt": stepper.dt,
        "y": jax.vmap(system.restrict)(trajectory.displacement),
        "v": jax.vmap(system.restrict)(trajectory.velocity),
        "trajectory": trajectory,
        "ledger": ledger,
        "cost": cost,
        "slope": sum(jnp.sum(x) for x in jax.tree.leaves(products)),
        "slope_size": sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(products)),
    }


def _outcomes(kind, values, direction, fixed):
    cases = values, direction, fixed
    return jax.lax.map(lambda case: outcome(kind, *case), cases, batch_size=LANES)


def _single(kind, values, fixed):
    return motion(kind, values, fixed)[1]


@cache
def _compiled(function, is_iterative):
    """Compiled in half the time, without optimisation, where the runs are short"""
    options = {"xla_backend_optimization_level": 3 if is_iterative else 0}
    return jax.jit(function, static_argnums=0, compiler_options=options)


@dataclass(frozen=True)
class Batch:
    """Cases of one kind with their outcomes, stacked along the first axis"""

    kind: Kind
    seeds: tuple[int, ...]
    values: dict
    fixed: dict
    outcomes: tuple[dict, dict, dict]
    """At the values, and one `STEP` of the direction ahead and back"""

    def case(self, k):
        """Values and constants of one case"""
        return jax.tree.map(lambda x: x[k], (self.values, self.fixed))

    def single(self, k):
        """The trajectory of one case, by a program of its own"""
        return _compiled(_single, self.kind.is_iterative)(self.kind, *self.case(k))

    def plain(self, k):
        """The trajectory of one case as a user calls it; may raise"""
        return motion(self.kind, *self.case(k))[1]


def run(kind, seeds):
    """Run the cases of a kind with these seeds"""
    cases = [draw(kind, seed) for seed in seeds]
    values, direction, fixed = (
        jax.tree.map(lambda *x: np.stack(x), *part) for part in zip(*cases, strict=True)
    )
    outcomes = []
    for sign in (0.0, 1.0, -1.0):
        moved = jax.tree.map(lambda x, dx, s=sign: x + s * STEP * dx, values, direction)
        found = _compiled(_outcomes, kind.is_iterative)(kind, moved, direction, fixed)
        outcomes.append(jax.tree.map(np.asarray, found))
    return Batch(kind, tuple(seeds), values, fixed, tuple(outcomes))
