"""Ready-made scenes: the paper's half disc and its control problem, two bodies, Hertz in 3D."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxcontact.control.cost import TrackingCost
from jaxcontact.motion.memory import check_run_memory
from jaxcontact.motion.simulate import simulate
from jaxcontact.motion.stepper import Stepper, prepare
from jaxcontact.scene import meshes
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.join import join
from jaxcontact.scene.material import KelvinVoigt
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.obstacle import HalfSpace
from jaxcontact.scene.scene import Scene
from jaxcontact.system.discretize import discretize
from jaxcontact.system.system import System

RADIUS = 15.0
#: Where the centre of the ball comes to lie, below its middle: cells are nearer to the contact.
NEARER = 0.8
#: Half a turn in the plane.
UPSIDE_DOWN = np.diag([-1.0, -1.0])
RUBBER = KelvinVoigt(young=1e8, poisson=0.3, bulk_viscosity=1e4, shear_viscosity=1e4, density=1.0)


def half_disc(h: float = RADIUS / 8, gap: float = 0.8) -> Scene:
    """Return the half disc of the paper above a rigid plane.

    Radius 15 m, flat side clamped on top, contact on the middle third of the arc, E = 1e8 Pa,
    nu = 0.3, bulk and shear viscosity 1e4 Pa s, density 1 kg/m^2.

    Args:
        h: mesh size, [m]; the default has 200 unknowns.
        gap: height of the lowest point above the plane, [m].
    """
    return Scene(
        mesh=meshes.half_disc(RADIUS, h=h),
        material=RUBBER,
        clamped=("clamped",),
        contact={
            "contact": HalfSpace(point=np.array([0.0, -RADIUS - gap]), normal=np.array([0.0, 1.0]))
        },
    )


def two_half_discs(h: float = RADIUS / 8, gap: float = 0.8) -> Scene:
    """Return the half disc of the paper above its mirror image, each clamped at its flat side.

    The bodies are "upper", the contact set, and "lower"; under mirrored loads the upper one moves
    as `half_disc` does. Source: paper, Example 4.22.

    Args:
        h: mesh size, [m].
        gap: distance of each body from the plane between them, [m].
    """
    body = meshes.half_disc(RADIUS, h=h)
    below = np.array([0.0, -2.0 * (RADIUS + gap)])
    return Scene(
        mesh=join({"upper": body, "lower": body.moved(UPSIDE_DOWN, below)}),
        material=RUBBER,
        clamped=("upper/clamped", "lower/clamped"),
        contact={"upper/contact": Facets("lower/contact", along=np.array([0.0, -1.0]))},
    )


def two_discs(h: float = 0.1, gap: float = 0.1) -> Scene:
    """Return two free elastic discs on top of each other, of other sizes, materials and meshes.

    "large": radius 1 m, E = 1 Pa, density 1 kg/m^2, around the origin; "small", the contact set:
    radius 0.7 m, E = 3 Pa, density 1.5 kg/m^2, above it; nu = 0.3, no viscosity. Elastic waves keep
    a part of the energy of an impact. Source: Gerl, Zippelius, Phys. Rev. E 59 (1999).

    Args:
        h: mesh size, [m].
        gap: distance of the discs, [m].
    """
    large = meshes.disc(1.0, h=h).moved(UPSIDE_DOWN)
    small = meshes.disc(0.7, h=h).moved(translation=np.array([0.0, 1.7 + gap]))
    return Scene(
        mesh=join({"large": large, "small": small}),
        material={
            "large": KelvinVoigt(young=1.0, poisson=0.3, density=1.0),
            "small": KelvinVoigt(young=3.0, poisson=0.3, density=1.5),
        },
        contact={"small/contact": Facets("large/contact")},
    )


def bars(n_resting: int = 1, h: float = 0.02, gap: float = 1e-3) -> Scene:
    """Return Newton's cradle: a row of equal bars that touch, behind a gap from a first one.

    Length, Young's modulus and density are one (SI units), nu = 0. Thrown to the right with the
    speed v, the first bar "bar0" comes to rest with a contact force of v / 2 over the time 2, and
    the last bar leaves with v, n_resting + 1 after the impact. Source: Saint-Venant, J. Math. Pures
    Appl. 12 (1867).

    Args:
        n_resting: number of bars that rest, 1 or more.
        h: length of a cell, [m].
        gap: distance between the first bar and the others, [m].
    """
    places = [0.0, *(k + gap for k in range(1, n_resting + 1))]
    bar = meshes.interval(1.0, h=h)
    return Scene(
        mesh=join({f"bar{k}": bar.moved(translation=[x]) for k, x in enumerate(places)}),
        material=KelvinVoigt(young=1.0, poisson=0.0),
        contact={f"bar{k}/left": Facets(f"bar{k - 1}/right") for k in range(1, n_resting + 1)},
    )


def ball_on_plane(h: float = 1 / 8, gap: float = 0.0) -> Scene:
    """Return a ball above a rigid plane, the upper half of its surface clamped: Hertz in 3D.

    Radius, Young's modulus and density are one (SI units), nu = 0.3. The ball is mapped onto itself
    by a Möbius transformation, which keeps angles and makes the cells at the lowest point nine
    times smaller. Pressed on the plane by a depth d (`System.with_gap`), it carries by Hertz
    4/3 E* d^(3/2), E* = E / (1 - nu^2), with a contact radius d^(1/2). For d from 0.0025 to 0.01
    and h = 1/8, 1/12 (2460 and 7812 unknowns) the load is 12 to 15 % and 8 to 9 % higher: by the
    mesh, of second order in h, and by 4 to 6 % since the clamp is not infinitely far away.

    Args:
        h: mesh size before the map, [m].
        gap: height of the lowest point above the plane, [m].

    Source: Johnson, Contact Mechanics (1985), 4.2; Ratcliffe, Foundations of Hyperbolic Manifolds
    (2006), 4.5.
    """
    half, up = meshes.half_ball(1.0, h=h), np.array([0.0, 0.0, 1.0])
    is_below = half.points[:, 2] < 0.0  # the others are their own mirror images
    mirror = np.where(is_below, half.n_nodes - 1 + np.cumsum(is_below), np.arange(half.n_nodes))
    x = np.concatenate([half.points, half.points[is_below] * [1.0, 1.0, -1.0]])
    cells = np.concatenate([half.cells, mirror[half.cells][:, [1, 0, 2, 3]]])
    squares, along = np.sum(x**2, axis=1)[:, None], -2.0 * NEARER * x[:, 2:]
    moved = (1.0 + along + squares) * -NEARER * up + (1.0 - NEARER**2) * x
    ball = Mesh.from_arrays(moved / (1.0 + along + NEARER**2 * squares), cells)
    ball = ball.with_set("upper", lambda _, n: n[:, 2] > 0.0)
    return Scene(
        mesh=ball.with_set("lowest", lambda x, _: x[:, 2] < -0.96),
        material=KelvinVoigt(young=1.0, poisson=0.3),
        clamped=("upper",),
        contact={"lowest": HalfSpace(point=-(1.0 + gap) * up, normal=up)},
    )


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ControlProblem:
    """The optimal control problem: find the volume force that makes the body follow a target."""

    scene: Scene
    """The body and its obstacle."""

    system: System
    """The discretised scene."""

    stepper: Stepper
    """The prepared time-stepping scheme."""

    reference: Array
    """The control that made the target, (T, N, d), before scaling."""

    target: Array
    """Desired displacement y_d, (T+1, N, d) [m]."""

    dt: float = field(metadata={"static": True})
    """Length of a time step tau, [s]."""

    steps: int = field(metadata={"static": True})
    """Number of time steps T."""

    control_scale: float = field(metadata={"static": True})
    """Force density of a control of one, [N/m^2]."""

    control_weight: float = field(metadata={"static": True})
    """Tychonoff parameter alpha."""

    final_weight: float = field(metadata={"static": True})
    """Weight gamma of the final-time observation."""

    def simulate(self, u: Array):
        """Return the trajectory of a control u (T, N, d), before scaling."""
        return simulate(self.stepper, self.control_scale * u)

    def cost(self) -> TrackingCost:
        """Return the tracking functional."""
        return TrackingCost(
            self.system,
            dt=self.dt,
            target=self.target,
            control_weight=self.control_weight,
            final_weight=self.final_weight,
        )

    def objective(self, u: Array) -> Array:
        """Return the reduced functional J(S(u), u) of a control u (T, N, d), a scalar."""
        return self.cost()(self.simulate(u), u)


def half_disc_control(
    h: float = RADIUS / 8,
    steps: int = 150,
    dt: float = 5e-5,
    gap: float = 0.8,
    *,
    control_scale: float = 1e6,
    control_weight: float = 1e-2,
    final_weight: float = 7.5e-4,
    dtype=jnp.float64,
    **prepare_options,
) -> ControlProblem:
    """Return the optimal control problem of the paper's section 5.

    The target is the motion under the reference control u = -e_n on the whole body at all times.

    Args:
        h: mesh size, [m].
        steps: number of time steps T; 150 or, for the horizon of 0.075 s, 1500.
        dt: length of a time step, [s].
        gap: height of the lowest point above the plane, [m].
        control_scale: force density of a control of one, [N/m^2].
        control_weight: Tychonoff parameter alpha.
        final_weight: weight gamma of the final-time observation.
        dtype: floating point type.
        **prepare_options: scheme and solvers, see `prepare`.

    Raises:
        ValueError: if the motion has no room in the memory, or as `discretize` and `prepare`.
    """
    scene = half_disc(h, gap)
    system = discretize(scene, dtype=dtype)
    stepper = prepare(system, dt, **prepare_options)
    # Before the reference takes as much.
    check_run_memory(stepper, steps)
    down = jnp.asarray(-np.eye(system.dimension)[-1], dtype)
    reference = jnp.broadcast_to(down, (steps, system.n_nodes, system.dimension))
    return ControlProblem(
        scene=scene,
        system=system,
        stepper=stepper,
        reference=reference,
        target=simulate(stepper, control_scale * reference).displacement,
        dt=dt,
        steps=steps,
        control_scale=control_scale,
        control_weight=control_weight,
        final_weight=final_weight,
    )
