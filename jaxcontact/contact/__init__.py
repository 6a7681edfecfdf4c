"""The contact problem of one time step: its solvers, and its derivative on the critical cone."""

from jaxcontact.contact.complementarity import ContactSolver, Solution, Status
from jaxcontact.contact.gauss_seidel import ProjectedGaussSeidel
from jaxcontact.contact.newton import SemismoothNewton
from jaxcontact.contact.vi import ContactProblem

__all__ = [
    "ContactProblem",
    "ContactSolver",
    "ProjectedGaussSeidel",
    "SemismoothNewton",
    "Solution",
    "Status",
]
