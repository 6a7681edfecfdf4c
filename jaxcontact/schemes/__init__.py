"""Time-stepping schemes: each an option object on one factor and one contact problem per step."""

from jaxcontact.schemes.contact_implicit import ContactImplicit
from jaxcontact.schemes.interface import EnergyFlow, Scheme, StepInfo, StepState

__all__ = ["ContactImplicit", "EnergyFlow", "Scheme", "StepInfo", "StepState"]
