"""Factor-once linear solvers with the contact condensed to the contact pairs.

A solver is an option object with one method, `factorize`; the factor answers what a step asks
of the matrix D: solve with it, and solve a contact problem on it in one sweep (MATH.md 2).
"""

from jaxcontact.linear.choice import check_memory, choose_linear_solver
from jaxcontact.linear.conjugate_gradient import ConjugateGradient
from jaxcontact.linear.dense import Dense
from jaxcontact.linear.dissection.nested_dissection import NestedDissection
from jaxcontact.linear.interface import (
    CondensingFactor,
    ConstrainedFactor,
    Factor,
    LinearSolver,
    Partial,
    can_condense,
)

__all__ = [
    "CondensingFactor",
    "ConjugateGradient",
    "ConstrainedFactor",
    "Dense",
    "Factor",
    "LinearSolver",
    "NestedDissection",
    "Partial",
    "can_condense",
    "check_memory",
    "choose_linear_solver",
]
