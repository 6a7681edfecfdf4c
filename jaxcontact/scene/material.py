"""The Kelvin-Voigt material: isotropic linear elasticity with isotropic viscosity.

    stress = lambda tr(eps) I + 2 mu eps  +  lambda_v tr(eps') I + 2 mu_v eps',
    lambda = E nu / ((1 + nu)(1 - 2 nu)),   mu = E / (2 (1 + nu)),
    lambda_v = K_v - 2 G_v / 3,             mu_v = G_v        (bulk and shear viscosity K_v, G_v).

Two-dimensional bodies are in plane strain; in 1D, stress = (lambda + 2 mu) eps. Source: MATH.md 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.transforms.traced import as_array, is_traced

Number = float | Array | np.ndarray

#: What each field has to be, as a condition and in words.
_RANGES = {
    "young": (lambda x: (x > 0.0) & (x < np.inf), "positive"),
    "poisson": (
        lambda x: (x > -1.0) & (x < 0.5),
        "in (-1, 1/2); use 0.49 for nearly incompressible",
    ),
    "bulk_viscosity": (lambda x: (x >= 0.0) & (x < np.inf), "zero or positive"),
    "shear_viscosity": (lambda x: (x >= 0.0) & (x < np.inf), "zero or positive"),
    "density": (lambda x: (x > 0.0) & (x < np.inf), "positive"),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True, kw_only=True)
class KelvinVoigt:
    """An isotropic, linearly viscoelastic material; every field can be differentiated.

    Each field is a scalar, or one value per cell of the mesh, (E,). The values are checked by
    `discretize`; values that are out of range while JAX traces them make NaN matrices.

    Example:
        >>> steel = jc.KelvinVoigt(young=2.1e11, poisson=0.3, density=7850.0)
        >>> print("{:.3g} {:.3g} Pa".format(*steel.elastic_lame()))
        1.21e+11 8.08e+10 Pa
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
            not is_traced(viscosity) and not np.any(np.asarray(viscosity))
            for viscosity in (self.bulk_viscosity, self.shear_viscosity)
        )


def check_material(material: KelvinVoigt, n_cells: int | None = None) -> None:
    """Check the values that are concrete.

    Args:
        material: the material.
        n_cells: number of cells E; None is a material of a region, with scalars only.

    Raises:
        ValueError: if a value lies outside its range or is not finite, or is neither a scalar nor
            one value per cell.
    """
    for name, (is_in_range, description) in _RANGES.items():
        value = as_array(getattr(material, name))
        if value.shape not in ((), (n_cells,)):
            cellwise = "" if n_cells is None else f" or have one value per cell, ({n_cells},)"
            raise ValueError(
                f"KelvinVoigt.{name} must be a scalar{cellwise}, got shape {value.shape}; give "
                "each region its own material, Scene(material={region: KelvinVoigt(...)})"
            )
        if is_traced(value):
            continue
        value = np.asarray(value, float)
        wrong = np.flatnonzero(~is_in_range(value))
        if wrong.size:
            cells = f" in {wrong.size} cells, first {wrong[:5].tolist()}" if value.ndim else ""
            first = value.ravel()[wrong[0]]
            raise ValueError(f"KelvinVoigt.{name} must be {description}, got {first}{cells}")


def is_admissible(material: KelvinVoigt) -> Array:
    """Return whether every value lies in its range, a boolean scalar; for traced values."""
    values = {name: jnp.asarray(getattr(material, name)) for name in _RANGES}
    return jnp.all(
        jnp.stack(
            [jnp.all(is_in_range(values[name])) for name, (is_in_range, _) in _RANGES.items()]
        )
    )
