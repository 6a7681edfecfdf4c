"""Optimisation in the inner product of the controls: methods, bounds, parametrised controls.

The module is `jaxcontact.optimize`, and so is the function: to call the module is to call its
function `optimize`.
"""

import inspect
import sys
from types import ModuleType

from jaxcontact.control.actuators import Actuator, actuator, boundary_actuator
from jaxcontact.optimize.certificate import Stationarity
from jaxcontact.optimize.descend import Descent, descend
from jaxcontact.optimize.driver import optimize
from jaxcontact.optimize.finish import ExactFinish
from jaxcontact.optimize.homotopy import Homotopy
from jaxcontact.optimize.lbfgs import LBFGS
from jaxcontact.optimize.line_search import WeakWolfe
from jaxcontact.optimize.method import Ending
from jaxcontact.optimize.newton_cg import NewtonCG
from jaxcontact.optimize.optax_method import Optax
from jaxcontact.optimize.result import History, Result, load_result
from jaxcontact.optimize.stationarity import stationarity
from jaxcontact.optimize.steepest_descent import SteepestDescent

__all__ = [
    "LBFGS",
    "Actuator",
    "Descent",
    "Ending",
    "ExactFinish",
    "History",
    "Homotopy",
    "NewtonCG",
    "Optax",
    "Result",
    "Stationarity",
    "SteepestDescent",
    "WeakWolfe",
    "actuator",
    "boundary_actuator",
    "descend",
    "load_result",
    "optimize",
    "stationarity",
]


class _CallableModule(ModuleType):
    """A module with the name of its function, which may be called under this name."""

    __call__ = staticmethod(optimize)


sys.modules[__name__].__class__ = _CallableModule
__signature__ = inspect.signature(optimize)
