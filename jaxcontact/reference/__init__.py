"""Exact solutions with which the simulations are compared, as functions of (x, t).

| object                 | problem                                                   |
|------------------------|-----------------------------------------------------------|
| `ClampedBar` (P1)      | prestrained bar, clamped far end, periodic contact        |
| `FreeBar` (P2)         | free bar flies against a wall and rebounds                |
| `FallingBar` (P3)      | free bar falls on a floor under gravity                   |
| `BouncingMass`         | rigid point mass under gravity with restitution           |
| `Hertz`                | cylinder pressed on a rigid plane, static                 |
| `first_touch_loss`     | energy that the contact-implicit scheme loses at impact   |

The parameters are float leaves of a pytree: `jax.grad(lambda bar: bar.impulse())(bar)` is a bar of
derivatives. Bars are one-dimensional: energies, forces and impulses are per cross-section area.
"""

from jaxcontact.reference.bouncing_mass import BouncingMass
from jaxcontact.reference.clamped_bar import ClampedBar
from jaxcontact.reference.falling_bar import FallingBar
from jaxcontact.reference.first_touch import first_touch_loss
from jaxcontact.reference.free_bar import FreeBar
from jaxcontact.reference.hertz import Hertz

__all__ = [
    "BouncingMass",
    "ClampedBar",
    "FallingBar",
    "FreeBar",
    "Hertz",
    "first_touch_loss",
]
