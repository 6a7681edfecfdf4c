"""Dynamic contact of viscoelastic bodies in JAX, with exact gradients through the impact.

Shape comments use one letter per axis: N nodes, E or e cells, a b local nodes of a cell, d the
space dimension, i j components, n unknowns, C contact pairs, T time steps.
"""

from jaxcontact import meshes, reference, scenes
from jaxcontact.contact import (
    AlongDirection,
    CriticalCone,
    Inactive,
    ProjectedGaussSeidel,
    RelaxedContact,
    SemismoothNewton,
    Status,
    Strong,
    with_contact,
)
from jaxcontact.cost import TrackingCost, contact_force, contact_force_error, contact_time
from jaxcontact.derivative import (
    DerivativeReport,
    GradientCheck,
    check_gradient,
    derivative_report,
    directional_derivative,
)
from jaxcontact.energy import Energy, energy
from jaxcontact.inner_product import l2_value_and_grad
from jaxcontact.io import read_mesh
from jaxcontact.linear import ConjugateGradient, Dense, NestedDissection
from jaxcontact.material import KelvinVoigt
from jaxcontact.memory import MemoryEstimate, estimate_memory
from jaxcontact.mesh import Mesh
from jaxcontact.obstacle import Ball, HalfSpace, SignedDistance
from jaxcontact.optimize import (
    LBFGS,
    Actuator,
    Descent,
    History,
    Homotopy,
    NewtonCG,
    Optax,
    Result,
    Stationarity,
    SteepestDescent,
    WeakWolfe,
    actuator,
    boundary_actuator,
    descend,
    load_result,
    optimize,
    stationarity,
)
from jaxcontact.pressure import contact_pressure
from jaxcontact.reduction import reduce
from jaxcontact.scene import Scene
from jaxcontact.schemes import (
    BackwardEuler,
    ContactImplicit,
    ContactStabilized,
    RedistributedMass,
    Trapezoidal,
)
from jaxcontact.simulate import SolveError, simulate
from jaxcontact.static import StaticContact, solve_static
from jaxcontact.stepper import Stepper, prepare
from jaxcontact.system import System, discretize
from jaxcontact.time_loop import Checkpoint
from jaxcontact.trajectory import State, Trajectory

__all__ = [
    "LBFGS",
    "Actuator",
    "AlongDirection",
    "BackwardEuler",
    "Ball",
    "Checkpoint",
    "ConjugateGradient",
    "ContactImplicit",
    "ContactStabilized",
    "CriticalCone",
    "Dense",
    "DerivativeReport",
    "Descent",
    "Energy",
    "GradientCheck",
    "HalfSpace",
    "History",
    "Homotopy",
    "Inactive",
    "KelvinVoigt",
    "MemoryEstimate",
    "Mesh",
    "NestedDissection",
    "NewtonCG",
    "Optax",
    "ProjectedGaussSeidel",
    "RedistributedMass",
    "RelaxedContact",
    "Result",
    "Scene",
    "SemismoothNewton",
    "SignedDistance",
    "SolveError",
    "State",
    "StaticContact",
    "Stationarity",
    "Status",
    "SteepestDescent",
    "Stepper",
    "Strong",
    "System",
    "TrackingCost",
    "Trajectory",
    "Trapezoidal",
    "WeakWolfe",
    "actuator",
    "boundary_actuator",
    "check_gradient",
    "contact_force",
    "contact_force_error",
    "contact_pressure",
    "contact_time",
    "derivative_report",
    "descend",
    "directional_derivative",
    "discretize",
    "energy",
    "estimate_memory",
    "l2_value_and_grad",
    "load_result",
    "meshes",
    "optimize",
    "prepare",
    "read_mesh",
    "reduce",
    "reference",
    "scenes",
    "simulate",
    "solve_static",
    "stationarity",
    "with_contact",
]
