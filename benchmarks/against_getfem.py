"""The same bar, mesh and step in GetFEM and here: do the programs agree, and what does a step cost?

The free bar hits a wall (`bars.free_bar`), touch in the middle of a step. GetFEM runs in a process
of its own, `getfem_bar.py`, with whichever Python can import it (Debian and Ubuntu: the package
python3-getfem); without one the benchmark says so and stops.
"""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common import bars, measure

import jaxcontact as jc

SCHEMES = {"ContactImplicit": jc.ContactImplicit(), "Trapezoidal": jc.Trapezoidal()}
PROGRAM = Path(__file__).parent / "common" / "getfem_bar.py"


def find_python() -> str | None:
    """Return a Python that can import GetFEM: this one or the system's; None if there is none."""
    for python in (sys.executable, "/usr/bin/python3"):
        try:
            found = subprocess.run([python, "-c", "import getfem"], capture_output=True)
        except OSError:
            continue
        if found.returncode == 0:
            return python
    return None


def run_getfem(python: str, record: dict) -> dict:
    """Run GetFEM on a record, see `getfem_bar.py`."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "result.json"
        subprocess.run(
            [python, str(PROGRAM), str(out)],
            input=json.dumps(record),
            text=True,
            check=True,
            capture_output=True,
        )
        return json.loads(out.read_text())


def compare(python: str, name: str, n: int, courant: float, repeats: int) -> dict:
    """Return the row of one scheme and mesh."""
    bar = bars.free_bar()
    dt = bars.time_step(bar, n, courant)
    exact, stepper, initial = bars.place(
        bar,
        jc.prepare(bars.discretize(bar, n), dt, scheme=SCHEMES[name]),
        jnp.asarray(5.0 + 5.0 * dt),
    )
    steps = math.ceil(bar.duration / dt)
    record = {
        "n": n,
        "length": bar.exact.length,
        "young": bar.exact.young,
        "density": bar.exact.density,
        "gap": float(exact.gap),
        "speed": -bar.velocity,
        "dt": dt,
        "steps": steps,
        "scheme": name,
    }
    theirs = run_getfem(python, record)
    program, _ = measure.compiled(
        lambda stepper, initial: jc.simulate(stepper, steps=steps, initial=initial),
        stepper,
        initial,
    )
    trajectory = jax.block_until_ready(program(stepper, initial))
    seconds = measure.seconds(lambda: program(stepper, initial), repeats)
    x, t = stepper.system.points[:, 0], trajectory.time
    distance = exact.gap + exact.displacement(x[None, :], t[:, None])
    mean = exact.contact_force_mean(t[:-1], t[1:])

    def errors(displacement, impulse) -> tuple[float, float]:
        error = exact.gap + displacement - distance
        force = jnp.sum(jnp.abs(jnp.asarray(impulse) - mean * dt)) / jnp.sum(mean * dt)
        return float(jnp.linalg.norm(error) / jnp.linalg.norm(distance)), float(force)

    mine = np.asarray(trajectory.displacement[:, :, 0])
    their = np.array(theirs["displacement"])
    eu, ef = errors(mine, trajectory.contact_impulse[:, 0])
    their_eu, their_ef = errors(their, theirs["impulse"])
    touch = int(0.5 / dt) + 3
    return {
        "scheme": name,
        "n": n,
        "courant": courant,
        "steps": steps,
        "eu": eu,
        "eu_getfem": their_eu,
        "ef": ef,
        "ef_getfem": their_ef,
        "difference": float(np.abs(mine - their).max()),
        "difference_first_touch": float(np.abs(mine - their)[:touch].max()),
        "us_per_step": 1e6 * seconds / steps,
        "us_per_step_getfem": 1e6 * theirs["seconds"] / steps,
    }


def main(argv: list[str] | None = None) -> list[dict] | None:
    """Compare the programs; returns None where GetFEM is not installed."""
    options = measure.parse(measure.parser(__doc__), argv)
    python = find_python()
    if python is None:
        print(
            "skipped: no Python here can import getfem; on Debian or Ubuntu install it with "
            "`apt-get install python3-getfem`"
        )
        return None
    sizes = [20] if options.quick else [100, 400]
    courants = [1.0] if options.quick else [0.5, 1.0, 4.0]
    rows = [
        compare(python, name, n, courant, options.repeats)
        for name in SCHEMES
        for n in sizes
        for courant in courants
    ]
    measure.print_table(rows)
    measure.save("against_getfem", rows, options.out)
    return rows


if __name__ == "__main__":
    main()
