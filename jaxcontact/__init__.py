"""Dynamic contact of viscoelastic bodies in JAX, with exact gradients through the impact.

Shape comments use one letter per axis: N nodes, E or e cells, a b local nodes of a cell, d the
space dimension, i j components, n unknowns, C contact pairs, T time steps.
"""

from jaxcontact import meshes, reference, scenes
from jaxcontact.contact import ProjectedGaussSeidel, SemismoothNewton, Status
from jaxcontact.cost import TrackingCost
from jaxcontact.energy import Energy, energy
from jaxcontact.inner_product import l2_value_and_grad
from jaxcontact.io import read_mesh
from jaxcontact.linear import ConjugateGradient, Dense
from jaxcontact.material import KelvinVoigt
from jaxcontact.mesh import Mesh
from jaxcontact.obstacle import Ball, HalfSpace, SignedDistance
from jaxcontact.scene import Scene
from jaxcontact.schemes import ContactImplicit
from jaxcontact.simulate import SolveError, simulate
from jaxcontact.stepper import Stepper, prepare
from jaxcontact.system import System, discretize
from jaxcontact.trajectory import State, Trajectory

__all__ = [
    "Ball",
    "ConjugateGradient",
    "ContactImplicit",
    "Dense",
    "Energy",
    "HalfSpace",
    "KelvinVoigt",
    "Mesh",
    "ProjectedGaussSeidel",
    "Scene",
    "SemismoothNewton",
    "SignedDistance",
    "SolveError",
    "State",
    "Status",
    "Stepper",
    "System",
    "TrackingCost",
    "Trajectory",
    "discretize",
    "energy",
    "l2_value_and_grad",
    "meshes",
    "prepare",
    "read_mesh",
    "reference",
    "scenes",
    "simulate",
]
