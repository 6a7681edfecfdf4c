"""The page that explains the results of `jaxcontact half-disc`: one sentence for each picture."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path

from jaxcontact.control.scenes import ControlProblem
from jaxcontact.transforms.files import atomic_write

#: Title, figure of the paper if there is one, and what is seen, in the order of the page.
CAPTIONS = {
    "motion.gif": (
        "The motion",
        "",
        "The half disc, clamped at its flat side, is pushed onto the plane by the control that was "
        "found, coloured by its magnitude; it touches, is pressed flat and springs back.",
    ),
    "control.png": (
        "The control",
        "figure 5",
        "Magnitude of the volume force per metre of thickness at a time in contact, on the moved "
        "body; the line is the plane.",
    ),
    "functional.png": (
        "The functional",
        "figure 6",
        "Value over the iterations, minus the best one that is known for this problem (that of a "
        "certified minimiser; where none is known, the least of this run): it stalls where the "
        "functional has a kink.",
    ),
    "distance.png": (
        "The distance to the reference control",
        "figure 7",
        "It does not fall to zero, and should not: the functional charges for the control itself, "
        "so that its minimiser is smaller than the reference, and a force on clamped nodes or one "
        "that only presses the body on the plane hardly moves the body.",
    ),
    "state-error.png": (
        "The distance to the desired motion",
        "figure 8",
        "L² norm of the difference to the desired displacement over time, beside that without "
        "control.",
    ),
    "contact-force.png": (
        "The contact force",
        "figure 9",
        "Force on each contact node per metre of thickness over its horizontal position, in the "
        "step of the first picture.",
    ),
    "active-set.png": (
        "Where and when the gap is closed",
        "",
        "Coloured by the force on the node. Stripes from step to step are chatter of the scheme "
        "(ContactImplicit, the one of the paper), not of the body; in Python "
        "scheme=jc.ContactStabilized() has none.",
    ),
    "stress.png": (
        "The stress",
        "",
        "Von Mises stress in plane strain at the same time, per metre of thickness, deformed to "
        "scale.",
    ),
    "energy.png": (
        "The energy",
        "",
        "Kinetic and elastic energy over time, and what went in as work of the control and out by "
        "viscosity and impact; the sum is closed to rounding.",
    ),
}
_STYLE = (
    "body{font:16px/1.5 sans-serif;max-width:60rem;margin:2rem auto;padding:0 1rem}"
    "img{max-width:100%}figure{margin:2rem 0}td{padding:.1rem 1rem .1rem 0;vertical-align:top}"
)


def write_page(path: Path, summary: Mapping[str, object], problem: ControlProblem) -> None:
    """Write the page `index.html` beside the pictures.

    Args:
        path: the file.
        summary: numbers of the run by name, for a table.
        problem: the control problem.
    """
    rows = "".join(
        f"<tr><td>{html.escape(name)}</td><td>{html.escape(str(text))}</td></tr>\n"
        for name, text in summary.items()
    )
    figures = "".join(_figure(name, *caption) for name, caption in CAPTIONS.items())
    page = (
        f'<!doctype html>\n<html lang="en">\n<meta charset="utf-8">\n<title>half disc</title>\n'
        f"<style>{_STYLE}</style>\n<h1>Optimal control of a bouncing half disc</h1>\n"
        "<p>Find the volume force that makes a viscoelastic half disc of radius 15 m follow the "
        "motion that the uniform force 1 MN/m² downward causes (Müller and Schiela, 2017, section "
        f"5). The body has {problem.system.size} unknowns; the motion {problem.steps} steps of "
        f"{problem.dt * 1e3:g} ms. Forces are per metre of thickness.</p>\n"
        f"<table>\n{rows}</table>\n{figures}"
        "<p><code>half-disc.pvd</code> opens in ParaView, <code>history.csv</code> has the "
        "iterations, <code>control.npz</code> the control, <code>config.json</code> arguments and "
        "versions.</p>\n</html>\n"
    )
    with atomic_write(path, "w") as file:
        file.write(page)


def _figure(name: str, title: str, number: str, text: str) -> str:
    paper = f" (paper, {number})" if number else ""
    return (
        f'<figure><h2>{html.escape(title)}{paper}</h2><img src="{name}" '
        f'alt="{html.escape(title)}"><figcaption>{html.escape(text)}</figcaption></figure>\n'
    )
