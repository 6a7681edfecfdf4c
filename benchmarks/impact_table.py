"""Which scheme does what when a bar hits a wall: displacement, force, chatter and energy.

P2, the free bar (`bars.free_bar`), mean over eight phases of the impact inside a step, for two
meshes; and P1, the clamped bar, over ten impacts. Prints the figures beside those of an independent
program and how far they are apart. Trapezoidal: force at the end of a step, as there; its mean
force is in the JSON. The chart shows the contact force of one impact.
"""

from __future__ import annotations

import numpy as np
from common import bars, measure

import jaxcontact as jc

SCHEMES = {
    "Trapezoidal": jc.Trapezoidal(),
    "ContactImplicit": jc.ContactImplicit(),
    "ContactStabilized": jc.ContactStabilized(),
    "RedistributedMass": jc.RedistributedMass(),
    "BackwardEuler": jc.BackwardEuler(),
}
COLUMNS = ("eu", "ef", "osc", "E_end")

#: An independent program: (scheme, Courant number) -> {n: (eu, ef, osc, E_end/E0)}.
INDEPENDENT = {
    ("Trapezoidal", 0.5): {200: (0.065, 1.7, 3.0, 18), 800: (0.035, 1.8, 3.7, 29)},
    ("Trapezoidal", 1.0): {200: (0.044, 1.30, 1.5, 14), 800: (0.024, 1.33, 1.5, 29)},
    ("Trapezoidal", 4.0): {200: (0.019, 0.62, 0.67, 0.997), 800: (0.0075, 0.57, 0.64, 0.999)},
    ("ContactImplicit", 0.5): {
        200: (0.0045, 0.51, 0.51, 0.9983),
        800: (0.0019, 0.51, 0.51, 0.9996),
    },
    ("ContactImplicit", 1.0): {
        200: (0.0058, 0.29, 0.29, 0.9980),
        800: (0.0024, 0.29, 0.29, 0.9995),
    },
    ("ContactImplicit", 4.0): {
        200: (0.020, 0.081, 0.072, 0.9932),
        800: (0.0078, 0.076, 0.072, 0.9983),
    },
    ("ContactStabilized", 1.0): {
        200: (0.0073, 0.0067, 0.0, 0.9970),
        800: (0.0027, 0.0025, 0.0, 0.9993),
    },
    ("ContactStabilized", 4.0): {
        200: (0.021, 0.019, 0.001, 0.9917),
        800: (0.0080, 0.0074, 0.0, 0.9980),
    },
    ("RedistributedMass", 1.0): {
        200: (0.0054, 0.0078, 0.0, 0.9993),
        800: (0.0023, 0.0027, 0.0, 0.9998),
    },
    ("BackwardEuler", 1.0): {200: (0.057, 0.040, 0.0, 0.871), 800: (0.029, 0.020, 0.0, 0.935)},
}
#: Energy after ten impacts of P1 at Courant number one: scheme -> {n: E/E0}.
TEN_IMPACTS = {
    "Trapezoidal": {100: 32, 400: 131},
    "ContactImplicit": {100: 0.985, 400: 0.997},
    "ContactStabilized": {100: 0.968, 400: 0.995},
    "RedistributedMass": {100: 0.986, 400: 0.996},
    "BackwardEuler": {100: 0.06, 400: 0.41},
}


def one_impact(name: str, n: int, courant: float, count: int = 8) -> dict:
    """Return the row of a scheme: means over the phases, the largest energy of all."""
    found = bars.run(bars.free_bar(), SCHEMES[name], n, courant, count=count)
    row = {
        "scheme": name,
        "courant": courant,
        "n": n,
        "eu": found.displacement.mean(),
        "ef": found.end_force.mean(),
        "osc": found.end_oscillation.mean(),
        "E_end": found.final_energy.mean(),
        "E_max": found.largest_energy.max(),
        "ef_mean_force": found.force.mean(),
        "osc_mean_force": found.oscillation.mean(),
        "ledger": found.ledger.max(),
    }
    independent = INDEPENDENT.get((name, courant), {}).get(n)
    if independent is not None:
        row |= {f"independent_{key}": v for key, v in zip(COLUMNS, independent, strict=True)}
        row["deviation"] = deviation(row)
    return row


def deviation(row: dict) -> float:
    """Return the largest relative deviation of a row from the independent figures.

    An oscillation that the other program gives as zero or with one digit only is no part of it.
    """
    keys = [key for key in COLUMNS if row[f"independent_{key}"] >= 0.0015]
    return max(abs(row[key] / row[f"independent_{key}"] - 1.0) for key in keys)


def is_stable(row: dict) -> bool:
    """Return False where the energy grows and the motion is chaotic."""
    return row["scheme"] != "Trapezoidal" or row.get("courant") == 4.0


def ten_impacts(name: str, n: int) -> dict:
    """Return the energy of a scheme after ten impacts of the clamped bar, T = 30."""
    bar = bars.clamped_bar(periods=10.0)
    dt = bars.time_step(bar, n, 1.0)
    stepper = jc.prepare(bars.discretize(bar, n), dt, scheme=SCHEMES[name])
    _, stepper, initial = bars.place(bar, stepper, 0.0)
    trajectory = jc.simulate(stepper, steps=round(30.0 / dt), initial=initial)
    total = np.asarray(jc.energy(stepper, trajectory).total)
    row = {"scheme": name, "n": n, "E_end": float(total[-1] / total[0])}
    independent = TEN_IMPACTS[name].get(n)
    if independent is not None:
        row |= {"independent_E_end": independent, "deviation": row["E_end"] / independent - 1.0}
    return row


def _show(row: dict) -> dict:
    """Return a row of the printed table: figure (independent figure)."""
    cells = {key: row[key] for key in ("scheme", "courant", "n") if key in row}
    for key in COLUMNS:
        if key in row:
            independent = row.get(f"independent_{key}")
            cells[key] = f"{row[key]:.4g}" + ("" if independent is None else f" ({independent:g})")
    cells["deviation"] = f"{row['deviation']:.1%}" if "deviation" in row else ""
    return cells


def chart(n: int):
    """Return the figure: the contact force of every scheme in the first phase, Courant number 1."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    bar = bars.free_bar()
    dt = bars.time_step(bar, n, 1.0)
    phase = bars.phases(bar, dt, 8)[0]
    figure, axes = plt.subplots(
        1, len(SCHEMES), figsize=(13, 2.8), sharey=True, layout="constrained"
    )
    for axis, (name, scheme) in zip(axes, SCHEMES.items(), strict=True):
        stepper = jc.prepare(bars.discretize(bar, n), dt, scheme=scheme)
        exact, stepper, initial = bars.place(bar, stepper, phase)
        trajectory = jc.simulate(stepper, steps=bars.n_steps(bar, dt), initial=initial)
        total = np.asarray(jc.energy(stepper, trajectory).total)
        middle = np.asarray(trajectory.time[1:]) - dt / 2
        axis.plot(middle, trajectory.contact_impulse[:, 0] / dt, lw=0.7)
        axis.plot(middle, exact.contact_force(middle), "k--", lw=0.8)
        axis.set(title=f"{name}\nenergy kept: {total[-1] / total[0]:.3g}", xlabel="time [s]")
        axis.set(xlim=(0.4, 1.3), ylim=(-50, 1000))
    axes[0].set_ylabel("contact force, dashed: exact")
    return figure


def main(argv: list[str] | None = None) -> dict[str, list[dict]]:
    """Run the tables."""
    options = measure.parse(measure.parser(__doc__), argv)
    sizes, courants, count = ([40], [1.0], 2) if options.quick else ([200, 800], [0.5, 1, 4], 8)
    impact_sizes = [20] if options.quick else [100, 400]
    impact = [
        one_impact(name, n, float(courant), count)
        for name in SCHEMES
        for courant in courants
        for n in sizes
    ]
    impacts = [ten_impacts(name, n) for name in SCHEMES for n in impact_sizes]
    print("One impact of P2; in brackets an independent program.")
    measure.print_table([_show(row) for row in impact])
    print("Ten impacts of P1.")
    measure.print_table([_show(row) for row in impacts])
    compared = [row for row in impact if "deviation" in row and is_stable(row)]
    if compared:
        print(
            f"Largest deviation over the {len(compared)} stable rows of one impact: "
            f"{max(row['deviation'] for row in compared):.1%}; over those of ten impacts: "
            f"{max(abs(row['deviation']) for row in impacts if is_stable(row)):.1%}."
        )
    tables = {"one_impact": impact, "ten_impacts": impacts}
    measure.save("impact_table", tables, options.out, phases=count)
    measure.save_chart(chart(sizes[0]), "impact_table", options.out)
    return tables


if __name__ == "__main__":
    main()
