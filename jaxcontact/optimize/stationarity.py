"""The certificate of strong stationarity for a control of any origin."""

from __future__ import annotations

from collections.abc import Callable

import jax.numpy as jnp
from jax import Array

from jaxcontact.control.bounds import BoundsLike
from jaxcontact.control.inner_product import InnerProduct
from jaxcontact.control.problem import ControlMap, Problem
from jaxcontact.motion.trajectory import Trajectory
from jaxcontact.optimize.certificate import Stationarity, certify, motion_of
from jaxcontact.system.system import System
from jaxcontact.transforms.precision import in_full_precision
from jaxcontact.transforms.trees import as_partial


@in_full_precision
def stationarity(
    objective: Callable[[Array], Array],
    u: Array,
    *,
    system: System | None = None,
    dt: float | Array | None = None,
    bounds: BoundsLike | None = None,
    controls: ControlMap | Callable[[Array], Array] | None = None,
    inner_product: InnerProduct | None = None,
    motion: Callable[[Array], Trajectory] | None = None,
    tolerance: float | None = None,
) -> Stationarity:
    """Certify a control on the exact problem: is it strongly stationary, (4.32)-(4.33)?

    Costs one simulation, and for every choice of the weak pairs one gradient and one per pair.

    Args:
        objective: maps a control (T, N, d) to a scalar; a pytree that holds the stepper: a bound
            method of a registered dataclass, or `jax.tree_util.Partial(function, stepper)`.
        u: the control, or the argument of the map `controls`.
        system: the discretised scene, which defines the inner product.
        dt: length of a time step, [s].
        bounds: lower and upper bound of u, see `optimize`.
        controls: linear map from parameters to controls.
        inner_product: used instead of the one of system and dt.
        motion: maps a control to the trajectory that the objective sees, recorded in every step;
            default the method `simulate` of the object whose bound method the objective is.
        tolerance: a pair is in weak contact if gap and impulse are below this times their largest
            values in the motion (impulses also below this times the momentum of a node). Default:
            1e-4 to 1e-9 are tried, and the verdict with right signs, a small residual and the
            fewest weak pairs is returned: no number fits both a control that is weak to rounding,
            beside pairs that are open by little, and one that is weak to 1e-5.

    Returns:
        The certificate.

    Raises:
        ValueError: if the motion is not known or not recorded in every step, or the gaps of its
            weak pairs have no room in the memory.
        SolveError: if a step of the motion was not solved.
    """
    u = jnp.asarray(u)
    problem = Problem.of(
        objective,
        u,
        system=system,
        dt=dt,
        bounds=bounds,
        controls=controls,
        inner_product=inner_product,
    )
    motion = motion_of(problem) if motion is None else as_partial(motion)
    if motion is None:
        raise ValueError(
            "the objective does not tell its motion; hand over motion=, a bound method or "
            "jax.tree_util.Partial that maps a control to the trajectory"
        )
    return certify(problem, u, motion, tolerance)
