"""Newton or Gauss-Seidel? Time of one contact problem against the number of contact pairs.

The compliance W is that of the bottom face of a flat box of tetrahedra. The offsets are those of a
tilted impact whose contact line moves by a little in every step. One compiled scan solves all
steps: Newton cold (from the empty set), Newton warm (from the last set), and projected
Gauss-Seidel, which has no use for a set.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from common import measure, speed_scenes
from jax import Array

import jaxcontact as jc
from jaxcontact.contact import ContactSolver, Guess, Status

PAIRS = [10, 20, 50, 100, 200, 500, 1_000]
LAYERS = 2


def flat_box(pairs: int, dtype: Any) -> speed_scenes.Body:
    """Return a flat box with about that many nodes at the bottom."""
    m = max(2, round(math.sqrt(pairs)) - 1)
    lengths = (1.0, 1.0, LAYERS / m)
    mesh = jc.meshes.box(lengths, h=(1.0 + 1e-9) / m)
    return speed_scenes.thrown(mesh, "bottom", 1.0 / m, dtype)


def offsets(body: speed_scenes.Body, steps: int) -> Array:
    """Return offsets (T, C): a tilted face that meets the plane, with a line that moves."""
    system = body.system
    x = system.points[system.contact_nodes, 0][None, :]
    phase = jnp.arange(steps, dtype=system.dtype)[:, None]
    line = 0.6 + 0.1 * jnp.sin(0.1 * phase)
    return speed_scenes.THROW * jnp.tanh(4.0 * (x - line))


def solve_all(solver: ContactSolver, is_warm: bool):
    """Return the function (W, offsets (T, C)) -> solutions that scans over the steps."""

    def run(compliance: Array, offset: Array):
        resolution = jnp.zeros_like(offset[0])
        first = Guess(jnp.zeros(offset.shape[1], bool), solver.first_workspace(compliance))

        def step(guess: Guess, q: Array):
            solution = solver.solve(compliance, q, resolution, guess)
            return (solution.guess if is_warm else guess), solution._replace(workspace=())

        return jax.lax.scan(step, first, offset)[1]

    return run


SOLVERS = {
    "newton_cold": solve_all(jc.SemismoothNewton(), False),
    "newton_warm": solve_all(jc.SemismoothNewton(), True),
    "gauss_seidel": solve_all(jc.ProjectedGaussSeidel(), False),
}


def measure_pairs(pairs: int, steps: int, dtype: Any, repeats: int) -> dict[str, Any]:
    """Return one row: all solvers on one compliance."""
    body = flat_box(pairs, dtype)
    compliance = speed_scenes.prepare(body).operators.problem.form.factor.compliance
    offset = offsets(body, steps)
    row: dict[str, Any] = {**body.sizes, "steps": steps}
    eigenvalues = np.linalg.eigvalsh(np.asarray(compliance, float))
    row["condition"] = float(eigenvalues[-1] / eigenvalues[0])
    runs, multipliers = {}, {}
    for name, run in SOLVERS.items():
        program, _ = measure.compiled(run, compliance, offset)
        solution = program(compliance, offset)
        assert np.all(np.asarray(solution.status) == Status.CONVERGED), f"{name}: not converged"
        multipliers[name] = np.asarray(solution.multiplier)
        row["active_pairs"] = float(np.mean(solution.active))
        row[f"{name}_iterations"] = float(np.mean(solution.iterations))
        runs[name] = lambda program=program: program(compliance, offset)
    largest = np.max(multipliers["newton_cold"])
    tolerance = 1e-8 if dtype == jnp.float64 else 1e-2
    for name, multiplier in multipliers.items():
        difference = np.max(np.abs(multiplier - multipliers["newton_cold"]))
        assert difference < tolerance * largest, f"{name} differs by {difference / largest:.1e}"
    seconds = measure.interleaved_seconds(runs, repeats)
    row |= {f"{name}_us": 1e6 * time / steps for name, time in seconds.items()}
    row["gauss_seidel_over_newton_warm"] = seconds["gauss_seidel"] / seconds["newton_warm"]
    return row


def draw(rows: list[dict], out: Path) -> None:
    """Draw the time of a contact problem against the number of pairs."""
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6, 4.2))
    pairs = [row["contact_pairs"] for row in rows]
    for name in SOLVERS:
        axes.loglog(pairs, [row[f"{name}_us"] for row in rows], "o-", label=name.replace("_", " "))
    axes.set(xlabel="contact pairs", ylabel="time of one contact problem [µs]")
    axes.legend()
    axes.grid(alpha=0.3)
    measure.save_chart(figure, "contact_solvers", out)
    plt.close(figure)


def main(argv: list[str] | None = None) -> list[dict]:
    """Run the benchmark; return its rows."""
    arguments = measure.parser(__doc__)
    arguments.add_argument("--pairs", type=int, nargs="*", default=PAIRS)
    options = measure.parse(arguments, argv)
    if options.quick:
        options.pairs = [10, 20]
    rows = []
    for pairs in options.pairs:
        steps = 10 if options.quick else int(np.clip(20_000 // pairs, 10, 200))
        row = measure_pairs(pairs, steps, options.dtype, options.repeats)
        measure.print_table([row])
        rows.append(row)
    measure.save("contact_solvers", rows, options.out, dtype=str(options.dtype))
    draw(rows, options.out)
    return rows


if __name__ == "__main__":
    main()
