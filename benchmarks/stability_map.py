"""Where is a scheme stable, and where is its contact force smooth?

The free bar hits a wall (`bars.free_bar`): Courant number c dt/h by viscosity eta/(rho c L), one
map for each scheme. Upper row: the largest energy over that at the start, the worst of some phases
of the impact inside a step. Lower row: standard deviation of the contact force in the middle of the
contact, where the exact force of the elastic bar is constant, over that force; mean over phases.
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


def rate(
    name: str, courant: float, viscosity: float, n: int, count: int, compiled_steps: int
) -> dict:
    """Return the worst energy growth and the mean force oscillation of a scheme.

    Args:
        name: key of `SCHEMES`.
        courant: Courant number.
        viscosity: eta / (rho c L).
        n: number of cells.
        count: number of phases.
        compiled_steps: see `bars.run`.
    """
    bar = bars.free_bar()
    exact = bar.exact
    scale = exact.density * float(exact.wave_speed()) * exact.length
    found = bars.run(
        bar,
        SCHEMES[name],
        n,
        courant,
        count=count,
        viscosity=viscosity * scale,
        compiled_steps=compiled_steps,
    )
    return {
        "scheme": name,
        "courant": courant,
        "viscosity": viscosity,
        "energy_growth": found.largest_energy.max(),
        "energy_end": found.final_energy.mean(),
        "oscillation": found.oscillation.mean(),
    }


def chart(rows: list[dict], courants: list[float], viscosities: list[float]):
    """Return the figure of the maps."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import LogNorm

    table = {(row["scheme"], row["courant"], row["viscosity"]): row for row in rows}
    figure, axes = plt.subplots(
        2, len(SCHEMES), figsize=(2.9 * len(SCHEMES), 4.6), layout="constrained", sharey=True
    )
    panels = (
        ("energy_growth", "largest energy / initial energy", LogNorm(1.0, 30.0), "inferno_r"),
        (
            "oscillation",
            "oscillation / force (0: < .001)",
            LogNorm(1e-3, 1.0),
            "viridis_r",
        ),
    )
    for line, (key, label, norm, colours) in zip(axes, panels, strict=True):
        image = None
        for axis, name in zip(line, SCHEMES, strict=True):
            values = [[table[name, c, v][key] for c in courants] for v in viscosities]
            image = axis.imshow(
                np.clip(values, norm.vmin, norm.vmax),
                norm=norm,
                cmap=colours,
                origin="lower",
                aspect="auto",
            )
            axis.set_xticks(range(len(courants)), [f"{c:g}" for c in courants], fontsize=7)
            axis.set_yticks(range(len(viscosities)), [f"{v:g}" for v in viscosities], fontsize=7)
            axis.set_title(name, fontsize=9)
            axis.set_xlabel("Courant number", fontsize=8)
            for i, row in enumerate(values):
                for j, value in enumerate(row):
                    shade = "white" if norm(value) > 0.6 else "black"
                    text = "0" if value < norm.vmin else f"{value:.2g}".removeprefix("0")
                    axis.text(j, i, text, ha="center", va="center", size=7, color=shade)
        line[0].set_ylabel("viscosity / (density c L)", fontsize=8)
        figure.colorbar(image, ax=list(line), label=label)
    return figure


def main(argv: list[str] | None = None) -> list[dict]:
    """Measure the maps and draw them."""
    options = measure.parse(measure.parser(__doc__), argv)
    courants = [1.0, 4.0] if options.quick else [0.1, 0.25, 0.5, 1.0, 2.0, 4.0, 10.0]
    viscosities = [0.0] if options.quick else [0.0, 1e-4, 1e-3, 1e-2]
    n, count = (50, 2) if options.quick else (100, 4)
    bar = bars.free_bar()
    needed = {courant: bars.n_steps(bar, bars.time_step(bar, n, courant)) for courant in courants}
    # Two programs for all Courant numbers: compilation takes longer than the runs.
    long, short = max(needed.values()), needed[1.0]
    rows = [
        rate(name, courant, viscosity, n, count, long if courant < 1.0 else short)
        for name in SCHEMES
        for viscosity in viscosities
        for courant in courants
    ]
    measure.print_table(rows)
    measure.save("stability_map", rows, options.out, cells=n, phases=count)
    measure.save_chart(chart(rows, courants, viscosities), "stability_map", options.out)
    return rows


if __name__ == "__main__":
    main()
