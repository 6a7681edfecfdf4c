"""Derivatives of the motion and their certificates."""

from jaxcontact.derivative.check import GradientCheck, check_gradient
from jaxcontact.derivative.directional import directional_derivative
from jaxcontact.derivative.report import DerivativeReport, derivative_report

__all__ = [
    "DerivativeReport",
    "GradientCheck",
    "check_gradient",
    "derivative_report",
    "directional_derivative",
]
