"""The Kelvin-Voigt material: isotropic linear elasticity with isotropic viscosity.

    stress = lambda tr(eps) I + 2 mu eps  +  lambda_v tr(eps') I + 2 mu_v eps',
    lambda = E nu / ((1 + nu)(1 - 2 nu)),   mu = E / (2 (1 + nu)),
    lambda_v = K_v - 2 G_v / 3,             mu_v = G_v        (bulk and shear viscosity K_v, G_v).

Two-dimensional bodies are in plane strain; in 1D, stress = (lambda + 2 mu) eps. Source: MATH.md 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jax import Array
from jax.core import Tracer

Number = float | Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class KelvinVoigt:
    """An isotropic, linearly viscoelastic material; every field can be differentiated.

    The values are checked by `discretize`.
    """

    young: Number
    """Young's modulus, [Pa], positive."""

    poisson: Number
    """Poisson's ratio, dimensionless, in (-1, 1/2)."""

    bulk_viscosity: Number = 0.0
    """Bulk viscosity, [Pa s], not negative."""

    shear_viscosity: Number = 0.0
    """Shear viscosity, [Pa s], not negative."""

    density: Number = 1.0
    """Mass density, [kg/m^d], positive."""

    def elastic_lame(self) -> tuple[Number, Number]:
        """Return the elastic Lame parameters (lambda, mu), [Pa]."""
        young, poisson = self.young, self.poisson
        first = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))
        return first, young / (2.0 * (1.0 + poisson))

    def viscous_lame(self) -> tuple[Number, Number]:
        """Return the viscous Lame parameters (lambda_v, mu_v), [Pa s]."""
        return self.bulk_viscosity - 2.0 / 3.0 * self.shear_viscosity, self.shear_viscosity

    def is_elastic(self) -> bool:
        """Return True if both viscosities are known to be zero (a traced viscosity is not)."""
        return all(
            not isinstance(viscosity, Tracer) and not np.any(np.asarray(viscosity))
            for viscosity in (self.bulk_viscosity, self.shear_viscosity)
        )


def check_material(material: KelvinVoigt) -> None:
    """Check the values that are concrete.

    Raises:
        ValueError: if a value lies outside its range, is not finite or is not a scalar.
    """
    admissible = {
        "young": (lambda x: x > 0.0, "positive"),
        "poisson": (lambda x: -1.0 < x < 0.5, "in (-1, 1/2); use 0.49 for nearly incompressible"),
        "bulk_viscosity": (lambda x: x >= 0.0, "zero or positive"),
        "shear_viscosity": (lambda x: x >= 0.0, "zero or positive"),
        "density": (lambda x: x > 0.0, "positive"),
    }
    for name, (is_admissible, description) in admissible.items():
        value = getattr(material, name)
        if np.ndim(value) != 0:
            raise ValueError(
                f"KelvinVoigt.{name} must be a scalar, got shape {np.shape(value)}; give each "
                "region its own material, Scene(material={region: KelvinVoigt(...)})"
            )
        if isinstance(value, Tracer):
            continue
        if not np.isfinite(value) or not is_admissible(float(value)):
            raise ValueError(f"KelvinVoigt.{name} must be {description}, got {value}")
