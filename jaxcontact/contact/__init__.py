"""The contact problem of one time step: its solvers, and its derivative on the critical cone."""

from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution, Status
from jaxcontact.contact.gauss_seidel import ProjectedGaussSeidel
from jaxcontact.contact.newton import SemismoothNewton
from jaxcontact.contact.relaxed import RelaxedContact, with_contact
from jaxcontact.contact.vi import ContactProblem
from jaxcontact.contact.weak import (
    AlongDirection,
    CriticalCone,
    Inactive,
    OnBranch,
    Strong,
    WeakContact,
)

__all__ = [
    "AlongDirection",
    "ContactProblem",
    "ContactSolver",
    "CriticalCone",
    "Guess",
    "Inactive",
    "OnBranch",
    "ProjectedGaussSeidel",
    "RelaxedContact",
    "SemismoothNewton",
    "Solution",
    "Status",
    "Strong",
    "WeakContact",
    "with_contact",
]
