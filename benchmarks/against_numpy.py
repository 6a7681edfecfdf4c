"""How fast is it against the same scheme written with NumPy and SciPy?

The loop that a researcher would write: factor D once with SuperLU (and CHOLMOD if scikit-sparse is
installed), precompute Z = D^-1 N^T and W = N Z, a primal-dual active set per step with the factor
of W kept while the set does not change, a Python loop over the steps, and the adjoint as a second
loop backwards. Same matrices, same results (asserted), one BLAS thread if threadpoolctl is there.
"""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.sparse
import scipy.sparse.linalg
from common import measure, speed_scenes

import jaxcontact as jc

SIZES = [500, 2_000, 10_000, 50_000]
AGREEMENT = {"float64": 1e-9, "float32": 1e-3}


def superlu(matrix: scipy.sparse.csc_matrix):
    """Return r -> D^-1 r by SciPy's SuperLU with its ordering for symmetric matrices."""
    options = {"SymmetricMode": True}
    lu = scipy.sparse.linalg.splu(
        matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options
    )
    return lu.solve


def cholmod(matrix: scipy.sparse.csc_matrix):
    """Return r -> D^-1 r by CHOLMOD."""
    from sksparse import cholmod as library  # pyright: ignore[reportMissingImports]

    return library.cholesky(matrix)


def installed() -> dict[str, Any]:
    """Return the sparse solvers that can be imported."""
    solvers: dict[str, Any] = {"superlu": superlu}
    with contextlib.suppress(ImportError):
        from sksparse.cholmod import cholesky  # pyright: ignore[reportMissingImports]  # noqa: F401

        solvers["cholmod"] = cholmod
    return solvers


def one_blas_thread() -> Any:
    """Return a context in which BLAS uses one thread, if threadpoolctl is installed."""
    try:
        from threadpoolctl import threadpool_limits  # pyright: ignore[reportMissingImports]
    except ImportError:
        return contextlib.nullcontext()
    return threadpool_limits(1, "blas")


class NumpyLoop:
    """The contact-implicit scheme (MATH.md 2) and its adjoint (MATH.md 3) as Python loops."""

    def __init__(self, body: speed_scenes.Body, factorize: Any):
        """Factor the matrix and precompute the contact compliance."""
        system = body.system
        self.dt = body.dt
        self.mass = system.mass.to_scipy()
        self.stiffness = system.stiffness.to_scipy()
        self.nodal_mass = system.nodal_mass.to_scipy()
        self.normals = system.normals.to_scipy(system.size)
        self.gap, self.load = np.asarray(system.gap), np.asarray(system.load)
        D = scipy.sparse.csc_matrix(self.mass + self.dt**2 / 4 * self.stiffness)
        self.solve = factorize(D)
        self.Z = self.solve(np.ascontiguousarray(self.normals.T.toarray()))
        self.W = self.normals @ self.Z
        self.initial = [
            np.asarray(x).ravel() for x in (body.initial.displacement, body.initial.velocity)
        ]
        self._set: np.ndarray | None = None

    def solve_on_set(self, active: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return p with (W p + q) = 0 on the active set, zero elsewhere."""
        if self._set is None or not np.array_equal(active, self._set):
            self._set = active
            self._factor = scipy.linalg.cho_factor(self.W[np.ix_(active, active)])
        p = np.zeros_like(q)
        if active.any():
            p[active] = scipy.linalg.cho_solve(self._factor, -q[active])
        return p

    def contact(self, q: np.ndarray, active: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return multiplier and active set of 0 <= p, W p + q >= 0, complementary."""
        noise = 1e-14 * np.abs(q).max()
        for _ in range(100):
            p = self.solve_on_set(active, q)
            following = np.where(active, p > 0, self.W @ p + q < -noise)
            if np.array_equal(following, active):
                return p, active
            active = following
        raise RuntimeError("the active set did not settle")

    def forward(self, control: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return displacements (T+1, n) and active sets (T, C) under a control (T, N, d)."""
        dt, N = self.dt, self.normals
        y, v = self.initial
        active = np.zeros(len(self.gap), bool)
        states, sets = [y], []
        for u in control:
            f = self.load + (self.nodal_mass @ u).ravel()
            w = self.solve(self.mass @ v - dt / 2 * (self.stiffness @ y - f))
            p, active = self.contact((self.gap - N @ y) / dt - N @ w, active)
            w -= self.Z @ p
            y, v = y + dt * w, 2 * w - v
            states.append(y)
            sets.append(active)
        return np.array(states), np.array(sets)

    def gradient(self, control: np.ndarray) -> tuple[float, np.ndarray]:
        """Return sum |y_k|^2 / 2 and its derivative by the control (T, N, d)."""
        dt, N = self.dt, self.normals
        states, sets = self.forward(control)
        y_bar, v_bar = np.zeros((2, states.shape[1]))
        gradient = np.empty(control.shape)
        for k in range(len(control) - 1, -1, -1):
            y_bar = y_bar + states[k + 1]
            z = self.solve(dt * y_bar + 2 * v_bar)
            mu = -self.solve_on_set(sets[k], N @ z)
            z -= self.Z @ mu
            y_bar = y_bar - dt / 2 * (self.stiffness @ z) - N.T @ mu / dt
            v_bar = self.mass @ z - v_bar
            gradient[k] = self.nodal_mass @ (dt / 2 * z).reshape(gradient[k].shape)
        return 0.5 * float(np.sum(states**2)), gradient


def objective(stepper: jc.Stepper, initial: jc.State, control: jax.Array) -> jax.Array:
    """Return sum |y_k|^2 / 2, the cost of both programs."""
    trajectory = jc.simulate(stepper, control, initial=initial)
    return 0.5 * jnp.sum(trajectory.displacement**2)


def assert_equal(name: str, ours: Any, theirs: Any, tolerance: float) -> float:
    """Return the largest difference relative to the largest value; assert that it is small."""
    error = float(np.max(np.abs(np.asarray(ours) - theirs)) / np.max(np.abs(theirs)))
    assert error < tolerance, f"{name} differ by {error:.1e}"
    return error


def measure_size(shape: str, n: int, solver: str, steps: int, dtype: Any, repeats: int) -> dict:
    """Return one row: our program against every loop on one body."""
    body = speed_scenes.SHAPES[shape](n, dtype)
    stepper = speed_scenes.prepare(body, solver)
    control = body.control(steps)
    arguments = (stepper, body.initial, control)
    forward, _ = measure.compiled(lambda s, i, u: jc.simulate(s, u, initial=i), *arguments)
    gradient, _ = measure.compiled(jax.value_and_grad(objective, argnums=2), *arguments)
    trajectory = forward(*arguments)
    row: dict[str, Any] = {"shape": shape, **body.sizes, "steps": steps}
    row |= speed_scenes.check(trajectory)
    force = np.asarray(control)
    runs = {
        "forward": lambda: forward(*arguments),
        "gradient": lambda: gradient(*arguments),
    }
    tolerance = AGREEMENT[str(dtype)]
    with one_blas_thread():
        for name, factorize in installed().items():
            loop = NumpyLoop(body, factorize)
            displacement = np.asarray(trajectory.displacement).reshape(steps + 1, -1)
            row[f"state_error_{name}"] = assert_equal(
                "states", displacement, loop.forward(force)[0], tolerance
            )
            row[f"gradient_error_{name}"] = assert_equal(
                "gradients", gradient(*arguments)[1], loop.gradient(force)[1], tolerance
            )
            runs[f"forward_{name}"] = lambda loop=loop: loop.forward(force)
            runs[f"gradient_{name}"] = lambda loop=loop: loop.gradient(force)
        seconds = measure.interleaved_seconds(runs, repeats)
    for run, time in seconds.items():
        row[f"{run}_us"] = 1e6 * time / steps
    for name in installed():
        row[f"forward_{name}_over_ours"] = seconds[f"forward_{name}"] / seconds["forward"]
        row[f"gradient_{name}_over_ours"] = seconds[f"gradient_{name}"] / seconds["gradient"]
    return row


def draw(rows: list[dict], out: Path) -> None:
    """Draw how many times slower the loops are."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4.2))
    for shape in dict.fromkeys(row["shape"] for row in rows):
        mine = [row for row in rows if row["shape"] == shape]
        for key, style in (("forward", "o-"), ("gradient", "s--")):
            for name in installed():
                ratio = [row[f"{key}_{name}_over_ours"] for row in mine]
                axes.semilogx(
                    [row["n"] for row in mine], ratio, style, label=f"{shape}, {key}, {name}"
                )
    axes.axhline(1.0, color="k", lw=0.8)
    axes.set(xlabel="unknowns", ylabel="time of the NumPy loop / time of jaxcontact")
    axes.set_ylim(bottom=0.0)
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "against_numpy", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--sizes", type=int, nargs="*", default=SIZES)
    arguments.add_argument("--shapes", nargs="*", default=["rectangle", "half_disc"])
    arguments.add_argument("--solver", choices=speed_scenes.SOLVERS, default="dissection")
    options = measure.parse(arguments, argv)
    if options.quick:
        options.sizes, options.shapes = [100], ["half_disc"]
    rows = []
    for shape in options.shapes:
        for n in options.sizes:
            steps = 30 if options.quick else int(np.clip(1_000_000 // n, 20, 300))
            row = measure_size(shape, n, options.solver, steps, options.dtype, options.repeats)
            measure.print_table([row])
            rows.append(row)
            jax.clear_caches()
    measure.save(
        "against_numpy", rows, options.out, dtype=str(options.dtype), solver=options.solver
    )
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
