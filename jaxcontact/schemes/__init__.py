"""Time-stepping schemes: each an option object with one or two contact problems per step."""

from jaxcontact.schemes.backward_euler import BackwardEuler
from jaxcontact.schemes.contact_implicit import ContactImplicit
from jaxcontact.schemes.contact_stabilized import ContactStabilized
from jaxcontact.schemes.interface import (
    Losses,
    Operators,
    Scheme,
    SchemeMatrices,
    StepResult,
    StepState,
)
from jaxcontact.schemes.redistributed_mass import RedistributedMass
from jaxcontact.schemes.trapezoidal import Trapezoidal

__all__ = [
    "BackwardEuler",
    "ContactImplicit",
    "ContactStabilized",
    "Losses",
    "Operators",
    "RedistributedMass",
    "Scheme",
    "SchemeMatrices",
    "StepResult",
    "StepState",
    "Trapezoidal",
]
