"""Small bodies that several test modules throw at obstacles."""

from dataclasses import replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

import jaxcontact as jc

ELASTIC = jc.KelvinVoigt(young=100.0, poisson=0.3)
VISCOUS = jc.KelvinVoigt(young=100.0, poisson=0.3, bulk_viscosity=0.2, shear_viscosity=0.1)
BLOCK = jc.meshes.rectangle((2.0, 1.0), h=0.5)
#: The wave needs 0.1 s through the block, the fall through the gap 0.14 s: contact after 7 steps.
DT = 0.02
#: Every time-stepping scheme, the default first.
SCHEMES = [
    jc.ContactImplicit(),
    jc.ContactStabilized(),
    jc.RedistributedMass(),
    jc.BackwardEuler(),
    jc.Trapezoidal(),
]


def block_scene(material=VISCOUS, *, gap=0.1, normal=(0.0, 1.0), force=(0.0, -10.0), mesh=BLOCK):
    """A free block of 30 unknowns whose bottom (5 nodes) is at the distance gap from a plane"""
    unit = jnp.asarray(normal) / jnp.linalg.norm(jnp.asarray(normal))
    bottom = mesh.points[np.unique(mesh.facets["bottom"])]
    plane = jc.HalfSpace((jnp.min(bottom @ unit) - gap) * unit, unit)
    return jc.Scene(mesh, material, contact={"bottom": plane}, body_force=jnp.asarray(force))


def discretized(scene):
    """The system of a scene, made in one program instead of a hundred small ones"""
    return jax.jit(lambda: jc.discretize(scene))()


def block(
    material=VISCOUS,
    *,
    gap=0.1,
    normal=(0.0, 1.0),
    force=(0.0, -10.0),
    dt=DT,
    contact_solver=None,
    dtype=jnp.float64,
):
    """The prepared block"""
    is_elastic = material.bulk_viscosity == material.shear_viscosity == 0.0
    return _prepare(material, gap, normal, force, dt, is_elastic, contact_solver, dtype)


# One program for all values of the scene.
@partial(jax.jit, static_argnums=(5, 6, 7))
def _prepare(material, gap, normal, force, dt, is_elastic, contact_solver, dtype):
    if is_elastic:  # not traced, so that there is no matrix of viscosity
        material = replace(material, bulk_viscosity=0.0, shear_viscosity=0.0)
    scene = block_scene(material, gap=gap, normal=normal, force=force)
    return jc.prepare(jc.discretize(scene, dtype=dtype), dt, contact_solver=contact_solver)


def random_control(steps, seed=0, size=10.0):
    """A control (T, N, 2) of the block, different on every node and step"""
    rng = np.random.default_rng(seed)
    return jnp.asarray(size * rng.normal(size=(steps, BLOCK.n_nodes, 2)))


def random_initial(seed=0, size=0.02):
    """A state of the block that penetrates nothing from a gap of 0.1 on"""
    rng = np.random.default_rng(seed)
    fields = jnp.asarray(rng.uniform(-1.0, 1.0, size=(2, BLOCK.n_nodes, 2)))
    return jc.State(size * fields[0], fields[1])
