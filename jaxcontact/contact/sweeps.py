"""The sweeps over a step of bodies that turn, with the constant factor of D.

With D = M + h B + h^2 A, h = tau/2 or tau, and the forces g of `system/frames.py` find w, p with

    M w + h g(w) + N^T p = r,    N w <= b,    p >= 0,    p . (b - N w) = 0,                   (4)

g of a = A u + K e / h, K = D - M. M is isotropic, so that D turned by a frame Rm is the D that is
factorised, and a sweep is the contact problem of small displacements with turned normals,

    D x + (N Rm)^T p = Rm^T (r - M w - h g(w)),   (N Rm) x <= b - N w,   w <- w + Rm x.       (6)

Its fixed point solves (4) for every Rm; Rm is the frame in the middle of the step, kept over its
sweeps. Source: MATH.md 12.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.contact.complementarity import Guess, Solution, Status
from jaxcontact.contact.condensed import CondensedContact
from jaxcontact.contact.form import ContactForm
from jaxcontact.contact.vi import NO_PERTURBATION, Bound, ContactProblem, Perturbation
from jaxcontact.linear.turned import TurnedFactor, turned_factor
from jaxcontact.system.frames import Frames, FrameStart, FrameState, frame_start, turn, turned_force
from jaxcontact.system.small_matrices import cayley, product
from jaxcontact.system.sparse import ComponentwiseMatrix, ContactNormals, SymmetricMatrix

#: The sweeps end where the error that is left is estimated below this part of the velocity.
TOLERANCE = {"float64": 1e-13, "float32": 1e-6}

#: Sweeps before a step ends as not converged.
MAX_SWEEPS = 30


class Equation(NamedTuple):
    """What (4) is made of, and may be differentiated by; K nodes, C pairs."""

    matrix: SymmetricMatrix
    """D, (n, n)."""

    mass: ComponentwiseMatrix
    """M, (n, n)."""

    stiffness: SymmetricMatrix
    """A, (n, n)."""

    frames: Frames
    """The bodies that turn."""

    state: FrameState
    """R and u at the start of the step."""

    weights: Array
    """Rows of N, (C, d)."""

    rhs: Array
    """r, (n,)."""

    bound: Array
    """b, (C,)."""

    places: Array
    """Places of the contact nodes at the start of the step, (C, d) [m]."""

    more: Array
    """What b is larger by than the distance over tau, (C,) [m/s]."""

    span: Array
    """h, scalar [s]."""

    dt: Array
    """tau, scalar [s]."""


class Fixed(NamedTuple):
    """What the sweeps use and never differentiate."""

    form: ContactForm
    """Factor of D, condensed to the contact nodes, and contact solver."""

    unknowns: Array | np.ndarray
    """Unknowns of the rows of N, (C, d) int32."""

    resolution: Array
    """Rounding error of b, (C,)."""

    guess: Guess
    """Where the contact solver starts."""

    velocity: Array
    """Where the sweeps start, (n,)."""

    perturbation: Perturbation
    """Its `is_open` and `closed`."""


class Unknowns(NamedTuple):
    """The unknowns of the sweeps."""

    velocity: Array
    """w, (n,)."""

    increment: Array
    """Axial vector of W, (F, s)."""


class Start(NamedTuple):
    """What all sweeps over a step share."""

    frames: FrameStart
    """The frames at the start of the step."""

    force: Array
    """h A u, (n,)."""


def start_of(equation: Equation) -> Start:
    """Return what all sweeps over a step share."""
    force = equation.span * (equation.stiffness @ equation.state.deformation)
    return Start(frame_start(equation.frames, equation.state), force)


def make_sweep(
    equation: Equation,
    start: Start,
    fixed: Fixed,
    form: ContactForm,
    frame: Array,
    unknowns: Unknowns,
    guess: Guess,
) -> tuple[Unknowns, Solution, Array]:
    """Make one sweep (6); return the new unknowns, the solution of its VI and |x|."""
    matrix, mass, frames, dt = equation.matrix, equation.mass, equation.frames, equation.dt
    w, increment = unknowns
    weights, bound = contact_at(equation, fixed, w)
    shape = frames.reference.shape
    step, increment = turn(frames, start.frames, dt, w.reshape(shape), increment)
    # Both products with M at once, and h a = h A u + D e - M e.
    e = step.rate.reshape(-1)
    products = mass @ jnp.stack([w, e], axis=1)
    force = start.force + matrix @ e - products[:, 1]
    g = turned_force(frames, step, force.reshape(shape))
    rest = (equation.rhs - products[:, 0]).reshape(shape) - g
    rest = frames.apply(jnp.swapaxes(frame, 1, 2), rest, 1.0).reshape(-1)
    rows = _turned_rows(frames, weights, frame, fixed)
    if frames.is_concave:
        form = turned_form(form, jax.lax.stop_gradient(rows))
        guess = form.first_guess()._replace(active=guess.active)
    turned = ContactNormals(rows, fixed.unknowns, w.size)
    normals = ContactNormals(weights, fixed.unknowns, w.size)
    problem = ContactProblem(
        matrix,
        turned,
        form,
        perturbation=NO_PERTURBATION._replace(
            is_open=fixed.perturbation.is_open, closed=fixed.perturbation.closed
        ),
    )
    x, solution = problem.solve(rest, Bound(bound - normals @ w, fixed.resolution), guess)
    change = frames.apply(frame, x.reshape(shape), 1.0).reshape(-1)
    return Unknowns(w + change, increment), solution, jnp.max(jnp.abs(x))


def contact_at(equation: Equation, fixed: Fixed, velocity: Array) -> tuple[Array, Array]:
    """Return the rows of N (C, d) and b (C,) at a velocity w (n,).

    A node that meets a concave obstacle has them at its new place, where the tangent is in front
    of the obstacle: b = phi(x') / tau + nu' . w. All others keep them.
    """
    weights, bound, dt = equation.weights, equation.bound, equation.dt
    for meeting in equation.frames.meetings:
        if meeting.is_concave:
            pairs = meeting.pairs
            w = velocity[fixed.unknowns[pairs]]
            distance, normals = meeting.measure(equation.places[pairs] + dt * w)
            reached = distance / dt + jnp.sum(normals * w, axis=1) + equation.more[pairs]
            weights, bound = weights.at[pairs].set(normals), bound.at[pairs].set(reached)
    return weights, bound


def _turned_rows(frames: Frames, weights: Array, frame: Array, fixed: Fixed) -> Array:
    """Return the rows of N Rm, (C, d)."""
    d = weights.shape[1]
    identity = jnp.eye(d, dtype=weights.dtype)
    turns = frames.spread(frame, identity)
    if frames.numbers is not None:
        turns = turns[fixed.unknowns[:, 0] // d]
    terms = [weights[:, i, None] * turns[:, i, :] for i in range(d)]
    return sum(terms[1:], terms[0])


def turned_form(form: ContactForm, rows: Array) -> ContactForm:
    """Return the form of a prepared problem for other contact rows (C, d) at the same nodes."""
    assert isinstance(form, CondensedContact)
    assert isinstance(form.factor, TurnedFactor)
    nodal, places = form.factor.nodal, form.factor.places
    return CondensedContact(turned_factor(nodal, rows, places), form.contact_solver)


def middle_frame(equation: Equation, fixed: Fixed, increment: Array) -> tuple[Array, ContactForm]:
    """Return Rm, (F, d, d), and the factor for the normals that it turns; not differentiated."""
    frame = product(cayley(0.5 * increment), equation.state.rotation)
    form = fixed.form
    if equation.weights.shape[0]:
        form = turned_form(form, _turned_rows(equation.frames, equation.weights, frame, fixed))
    return jax.lax.stop_gradient((frame, form))


class _Search(NamedTuple):
    """The sweeps over a step."""

    unknowns: Unknowns
    """After the last sweep."""

    solution: Solution
    """Of its contact problem."""

    change: Array
    """|x| of it, scalar [m/s]."""

    error: Array
    """Estimated error that is left, scalar [m/s]; infinite before the first sweep."""

    steps: Array
    """Sweeps so far, int32."""


def run_sweeps(equation: Equation, fixed: Fixed) -> tuple[Unknowns, Solution]:
    """Sweep until the step is solved to `TOLERANCE`; its iterations count sweeps."""
    frames, state = equation.frames, equation.state
    shape = frames.reference.shape
    s = shape[1] * (shape[1] - 1) // 2
    velocity, dtype = fixed.velocity, fixed.velocity.dtype
    begin = start_of(equation)
    none = jnp.zeros((len(state.rotation), s), dtype)
    for _ in range(2):
        _, none = turn(frames, begin.frames, equation.dt, velocity.reshape(shape), none)
    frame, form = middle_frame(equation, fixed, none)
    first = Unknowns(velocity, none)
    guess = form.first_guess()._replace(active=fixed.guess.active)

    def sweep(unknowns: Unknowns, guess: Guess) -> tuple[Unknowns, Solution, Array]:
        return make_sweep(equation, begin, fixed, form, frame, unknowns, guess)

    # The rounding error of the free motion is that of h A u: for every tau some eps u / tau.
    size = jnp.max(jnp.abs(state.deformation), initial=0.0)
    rounding = 16.0 * jnp.finfo(dtype).eps * size / equation.dt
    tolerance = TOLERANCE[str(dtype)]

    def goal(unknowns: Unknowns) -> Array:
        speeds = jnp.maximum(jnp.abs(unknowns.velocity), jnp.abs(velocity))
        return tolerance * jnp.max(speeds) + rounding

    def is_unfinished(search: _Search) -> Array:
        return (search.error > goal(search.unknowns)) & (search.steps < MAX_SWEEPS)

    def advance(search: _Search) -> _Search:
        unknowns, solution, change = sweep(search.unknowns, search.solution.guess)
        # Linear convergence: the ratio of the last two changes tells what is left.
        rate = jnp.minimum(change / search.change, 0.5)
        rate = jnp.where(search.steps > 0, rate, 0.5)
        error = change * rate / (1.0 - rate)
        return _Search(unknowns, solution, change, error, search.steps + 1)

    # Not made before the loop: the program would hold a sweep twice.
    shapes = jax.eval_shape(sweep, first, guess)[1]
    unknown = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)
    unknown = unknown._replace(active=guess.active, workspace=guess.workspace)
    infinite = jnp.full((), jnp.inf, dtype)
    start = _Search(first, unknown, infinite, infinite, jnp.int32(0))
    found = jax.lax.while_loop(is_unfinished, advance, start)
    is_converged = found.error <= goal(found.unknowns)
    is_finite = jnp.isfinite(found.error)
    failed = jnp.where(is_finite, Status.NOT_CONVERGED, Status.NON_FINITE)
    status = jnp.maximum(found.solution.status, jnp.where(is_converged, 0, failed))
    solution = found.solution._replace(
        iterations=found.steps, status=status.astype(jnp.int32), workspace=(), separation=()
    )
    return found.unknowns, solution
