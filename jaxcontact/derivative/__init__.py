"""Derivatives of the motion and their certificates."""

from jaxcontact.derivative.check import GradientCheck, check_gradient
from jaxcontact.derivative.directional import directional_derivative
from jaxcontact.derivative.phase import PhaseMean, phase_mean
from jaxcontact.derivative.report import DerivativeReport, derivative_report
from jaxcontact.derivative.verdict import Verdict

__all__ = [
    "DerivativeReport",
    "GradientCheck",
    "PhaseMean",
    "Verdict",
    "check_gradient",
    "derivative_report",
    "directional_derivative",
    "phase_mean",
]
