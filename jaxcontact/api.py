"""The public names of the package, those of `import jaxcontact as jc`."""

from typing import TYPE_CHECKING

from jaxcontact import reference
from jaxcontact.accuracy.estimate import ErrorEstimate, estimate_error
from jaxcontact.accuracy.recommend import Recommendation, recommend
from jaxcontact.accuracy.reduction_error import ReductionError, reduction_error
from jaxcontact.contact import (
    AlongDirection,
    ClosedBranch,
    CriticalCone,
    OpenBranch,
    ProjectedGaussSeidel,
    RelaxedContact,
    SemismoothNewton,
    SmoothedContact,
    Status,
)
from jaxcontact.control import scenes
from jaxcontact.control.cost import TrackingCost, contact_force, contact_force_error, contact_time
from jaxcontact.control.inner_product import Euclidean, control_dot, l2_value_and_grad
from jaxcontact.derivative import (
    DerivativeReport,
    GradientCheck,
    PhaseMean,
    Verdict,
    check_gradient,
    derivative_report,
    directional_derivative,
    phase_mean,
)
from jaxcontact.linear import ConjugateGradient, Dense, NestedDissection
from jaxcontact.motion.chatter import ChatterWarning
from jaxcontact.motion.checks import SolveError
from jaxcontact.motion.energy import Energy, energy
from jaxcontact.motion.files import load_trajectory
from jaxcontact.motion.linearization import linearization_error, turned_gap
from jaxcontact.motion.memory import MemoryEstimate, estimate_memory
from jaxcontact.motion.momentum import Momentum, momentum
from jaxcontact.motion.pressure import contact_pressure
from jaxcontact.motion.progress import Progress
from jaxcontact.motion.schedule import Schedule, sample
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.static import StaticContact, solve_static
from jaxcontact.motion.step import step
from jaxcontact.motion.stepper import Stepper, prepare, with_contact
from jaxcontact.motion.stress import Stress, stress
from jaxcontact.motion.trajectory import State, Trajectory
from jaxcontact.optimize import (
    LBFGS,
    Actuator,
    Descent,
    Ending,
    ExactFinish,
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
    stationarity,
)
from jaxcontact.scene import meshes
from jaxcontact.scene.compound import Along, Union
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.io import read_mesh
from jaxcontact.scene.join import join
from jaxcontact.scene.material import KelvinVoigt
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.obstacle import Ball, HalfSpace, SignedDistance
from jaxcontact.scene.quality import MeshQuality
from jaxcontact.scene.scene import Scene
from jaxcontact.schemes import (
    BackwardEuler,
    ContactImplicit,
    ContactStabilized,
    RedistributedMass,
    Trapezoidal,
)
from jaxcontact.system.discretize import discretize
from jaxcontact.system.files import load_system
from jaxcontact.system.reduction import reduce
from jaxcontact.system.system import System
from jaxcontact.transforms.time_loop import Checkpoint

if TYPE_CHECKING:
    from jaxcontact.optimize import optimize
else:
    from jaxcontact import optimize

__all__ = [
    "LBFGS",
    "Actuator",
    "Along",
    "AlongDirection",
    "BackwardEuler",
    "Ball",
    "ChatterWarning",
    "Checkpoint",
    "ClosedBranch",
    "ConjugateGradient",
    "ContactImplicit",
    "ContactStabilized",
    "CriticalCone",
    "Dense",
    "DerivativeReport",
    "Descent",
    "Ending",
    "Energy",
    "ErrorEstimate",
    "Euclidean",
    "ExactFinish",
    "Facets",
    "GradientCheck",
    "HalfSpace",
    "History",
    "Homotopy",
    "Inactive",
    "KelvinVoigt",
    "MemoryEstimate",
    "Mesh",
    "MeshQuality",
    "Momentum",
    "NestedDissection",
    "NewtonCG",
    "OpenBranch",
    "Optax",
    "PhaseMean",
    "Progress",
    "ProjectedGaussSeidel",
    "Recommendation",
    "RedistributedMass",
    "ReductionError",
    "RelaxedContact",
    "Result",
    "Scene",
    "Schedule",
    "SemismoothNewton",
    "SignedDistance",
    "SmoothedContact",
    "SolveError",
    "State",
    "StaticContact",
    "Stationarity",
    "Status",
    "SteepestDescent",
    "Stepper",
    "Stress",
    "Strong",
    "System",
    "TrackingCost",
    "Trajectory",
    "Trapezoidal",
    "Union",
    "Verdict",
    "WeakWolfe",
    "actuator",
    "boundary_actuator",
    "check_gradient",
    "contact_force",
    "contact_force_error",
    "contact_pressure",
    "contact_time",
    "control_dot",
    "derivative_report",
    "descend",
    "directional_derivative",
    "discretize",
    "energy",
    "estimate_error",
    "estimate_memory",
    "join",
    "l2_value_and_grad",
    "linearization_error",
    "load_result",
    "load_system",
    "load_trajectory",
    "meshes",
    "momentum",
    "optimize",
    "phase_mean",
    "prepare",
    "read_mesh",
    "recommend",
    "reduce",
    "reduction_error",
    "reference",
    "sample",
    "scenes",
    "simulate",
    "solve_static",
    "stationarity",
    "step",
    "stress",
    "turned_gap",
    "with_contact",
]

#: The first names of the two branches of the derivative.
Strong, Inactive = ClosedBranch, OpenBranch
