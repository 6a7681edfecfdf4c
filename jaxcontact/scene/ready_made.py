"""Ready-made scenes: the paper's half disc, two bodies, Hertz in 3D, supports that move.

A state or a schedule to go with a scene is named in its docstring.
"""

from __future__ import annotations

import numpy as np

from jaxcontact.scene import meshes
from jaxcontact.scene.facets import Facets
from jaxcontact.scene.join import join
from jaxcontact.scene.material import KelvinVoigt
from jaxcontact.scene.mesh import Mesh
from jaxcontact.scene.obstacle import Ball, HalfSpace
from jaxcontact.scene.scene import Scene

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
    and h = 1/8, 1/12 (2460 and 7812 unknowns) the load is 12 to 15 % and 8 to 9 % higher, mostly by
    the mesh.

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


def bar_on_wall(h: float = 0.5) -> Scene:
    """Return a steel bar before a rigid wall, in inches, pounds-force and seconds.

    Length 10 in, E = 3e7 psi, density 7.3e-4 lbf s^2/in^4, area 1 in^2, gap .01 in to the wall on
    its left. Thrown at it with -202.2 in/s it touches after 4.946e-5 s, leaves at 1.481e-4 s, and
    presses with 2.992e4 lbf in between. The density is that which fits these results.
    Source: Ansys, Mechanical APDL Verification Manual (2013), VM265.

    Args:
        h: length of a cell, [in]; the default has 20.
    """
    return Scene(
        mesh=meshes.interval(10.0, h=h),
        material=KelvinVoigt(young=3e7, poisson=0.0, density=7.3e-4),
        contact={"left": HalfSpace(point=np.array([-0.01]), normal=np.array([1.0]))},
    )


def disc_in_bowl(h: float = 0.2, gap: float = 0.01, angle: float = 0.2) -> Scene:
    """Return a free disc in a round bowl of three times its radius, beside its lowest point.

    Radius, Young's modulus and density of the disc are one (SI units), nu = 0.3, weight 0.01. It
    hangs back, to and fro: without friction it slides and does not roll.

    Args:
        h: mesh size, [m].
        gap: distance of disc and bowl, [m].
        angle: of the disc from the lowest point, seen from the centre of the bowl, [rad].
    """
    place = (2.0 - gap) * np.array([np.sin(angle), -np.cos(angle)])
    return Scene(
        mesh=meshes.disc(1.0, h=h).moved(translation=place),
        material=KelvinVoigt(young=1.0, poisson=0.3),
        contact={"boundary": Ball(center=np.zeros(2), radius=3.0, inside=True)},
        body_force=np.array([0.0, -0.01]),
    )


def tumbling_block(h: float = 0.125, size: float = 3.0) -> Scene:
    """Return a block that may turn, 1 m x 0.5 m, in the middle of a square box of four walls.

    E = 1e6 Pa, nu = 0.3, bulk and shear viscosity 100 Pa s, density 1000 kg/m^2, so that waves run
    at 37 m/s. There is no gravity. Thrown at 5 m/s it turns from wall to wall.

    Args:
        h: mesh size, [m].
        size: length of the walls, [m].
    """
    block, half = meshes.rectangle((1.0, 0.5), h=h), 0.5 * size
    walls = tuple(
        HalfSpace(point=-half * np.array(inward), normal=np.array(inward))
        for inward in ([1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0])
    )
    return Scene(
        mesh=block.moved(translation=np.array([-0.5, -0.25])),
        material=KelvinVoigt(
            young=1e6, poisson=0.3, bulk_viscosity=100.0, shear_viscosity=100.0, density=1000.0
        ),
        contact=dict.fromkeys(block.facets, walls),
        large_rotation=True,
    )


def spinning_ball(h: float = 0.5, gap: float = 0.01, angle: float = 0.2) -> Scene:
    """Return a free ball that may turn in a round bowl of three times its radius.

    The body of `disc_in_bowl` in space. Without friction the bowl does not slow a spin down.

    Args:
        h: mesh size, [m].
        gap: distance of ball and bowl, [m].
        angle: of the ball from the lowest point, seen from the centre of the bowl, [rad].
    """
    place = (2.0 - gap) * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    return Scene(
        mesh=meshes.ball(1.0, h=h).moved(translation=place),
        material=KelvinVoigt(young=1.0, poisson=0.3),
        contact={"boundary": Ball(center=np.zeros(3), radius=3.0, inside=True)},
        body_force=np.array([0.0, 0.0, -0.01]),
        large_rotation=True,
    )


def bumper(h: float = 0.25, slope: float = 0.3, gap: float = 0.02) -> Scene:
    """Return a block between vertical rollers above an inclined plane that fits its lower side.

    Unit size, Young's modulus and density (SI units), nu = 0.3, weight 0.01. The plane pushes it
    upwards and against a roller.

    Args:
        h: mesh size, [m].
        slope: of the plane, rise over run.
        gap: vertical distance of the plane, [m].
    """
    block = meshes.rectangle((1.0, 1.0), h=h)
    sheared = block.points + slope * block.points[:, :1] * np.array([0.0, 1.0])
    plane = HalfSpace(point=np.array([0.0, -gap]), normal=np.array([-slope, 1.0]))
    return Scene(
        mesh=block.with_points(sheared),
        material=KelvinVoigt(young=1.0, poisson=0.3),
        rollers={"left": None, "right": None},
        contact={"bottom": plane},
        body_force=np.array([0.0, -0.01]),
    )


def press(h: float = 0.25, gap: float = 0.02) -> Scene:
    """Return a block on a table of rollers under the stamp of a press.

    Unit size, Young's modulus and density of the block are one (SI units), nu = 0.3; the stamp,
    half as wide, is ten times as stiff and clamped at its top, "stamp/top", which a
    `Schedule(motion={"stamp/top": ...})` moves.

    Args:
        h: mesh size, [m].
        gap: distance of the stamp, [m].
    """
    stamp = meshes.rectangle((0.5, 0.5), h=0.75 * h)
    return Scene(
        mesh=join(
            {
                "block": meshes.rectangle((1.0, 1.0), h=h),
                "stamp": stamp.moved(translation=np.array([0.25, 1.0 + gap])),
            }
        ),
        material={
            "block": KelvinVoigt(young=1.0, poisson=0.3),
            "stamp": KelvinVoigt(young=10.0, poisson=0.3),
        },
        clamped=("stamp/top",),
        rollers={"block/bottom": None, "block/left": None},
        contact={"stamp/bottom": Facets("block/top", along=np.array([0.0, -1.0]))},
    )
