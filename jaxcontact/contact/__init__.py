"""The contact problem of one time step: its solvers, and its derivative on the critical cone."""

from jaxcontact.contact.complementarity import ContactSolver, Guess, Solution, Status
from jaxcontact.contact.form import ContactForm
from jaxcontact.contact.gauss_seidel import ProjectedGaussSeidel
from jaxcontact.contact.newton import SemismoothNewton
from jaxcontact.contact.relaxed import RelaxedContact
from jaxcontact.contact.smoothed import SmoothedContact
from jaxcontact.contact.vi import Bound, ContactProblem, Perturbation, contact_problem
from jaxcontact.contact.weak import (
    AlongDirection,
    ClosedBranch,
    CriticalCone,
    OpenBranch,
    WeakContact,
)

__all__ = [
    "AlongDirection",
    "Bound",
    "ClosedBranch",
    "ContactForm",
    "ContactProblem",
    "ContactSolver",
    "CriticalCone",
    "Guess",
    "OpenBranch",
    "Perturbation",
    "ProjectedGaussSeidel",
    "RelaxedContact",
    "SemismoothNewton",
    "SmoothedContact",
    "Solution",
    "Status",
    "WeakContact",
    "contact_problem",
]
