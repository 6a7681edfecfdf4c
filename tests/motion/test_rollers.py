"""Rollers: equal to an elimination in a turned basis, in every scheme; exact where it is known."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import independent
from support.bodies import SCHEMES
from support.thrown_bodies import DT, MESHES, STEPS, cost, initial_of, parameters, up

import jaxcontact as jc
from jaxcontact.system.basis import Basis
from jaxcontact.system.rollers import hold
from jaxcontact.system.sparse import ContactNormals, SymmetricMatrix

RUBBER = jc.KelvinVoigt(young=1.0, poisson=0.3)
SLANTED = {2: np.array([1.0, 0.5]), 3: np.array([1.0, -0.3, 0.2])}
SLOW = pytest.mark.slow
#: Every scheme that needs no mesh, the default in the fast pass.
ON_ANY_SYSTEM = [
    SCHEMES[0],
    *(pytest.param(x, marks=SLOW) for x in SCHEMES[1:] if x != jc.RedistributedMass()),
]
# Twenty-four steps of sums over 40 unknowns, some of them in contact.
ROUNDING = 1e-12


def scene_of(values, rollers):
    d = values["points"].shape[1]
    plane = jc.HalfSpace(**values["obstacle"])
    return jc.Scene(
        MESHES[d].with_points(values["points"]),
        jc.KelvinVoigt(**values["material"]),
        rollers=rollers,
        contact={"bottom": plane},
        body_force=values["body_force"],
    )


def prepared(values, rollers, dtype=jnp.float64, **options):
    system = jax.jit(lambda: jc.discretize(scene_of(values, rollers), dtype=dtype))()
    return jc.prepare(system, DT, **options)


def allowed_motions(system, held):
    """An orthonormal basis of the motions of free nodes across directions {node: (k, d)}, (n, m)"""
    d, rows = system.dimension, []
    for node, directions in held.items():
        for direction in np.atleast_2d(directions):
            rows.append(np.zeros(system.size))
            rows[-1][d * node : d * node + d] = direction
    return np.linalg.svd(np.array(rows))[2][len(rows) :].T


def eliminated(system, Q):
    """The system of the unknowns q, y = Q q"""

    def dense(matrix):
        return SymmetricMatrix(jnp.asarray(Q.T @ matrix.to_scipy().toarray() @ Q), None)

    rows = jnp.asarray(system.normals.to_scipy().toarray() @ Q)
    unknowns = np.broadcast_to(np.arange(Q.shape[1], dtype=np.int32), rows.shape)
    return replace(
        system,
        mass=dense(system.mass),
        stiffness=dense(system.stiffness),
        viscosity=dense(system.viscosity),
        l2_mass=dense(system.l2_mass),
        normals=ContactNormals(rows, unknowns, Q.shape[1]),
        load=system.load @ Q,
        basis=Basis(
            jnp.asarray(Q),
            SymmetricMatrix(jnp.eye(len(Q)), None),
            system.normals,
            np.arange(system.normals.count),
            modes=0,
            mark="eliminated",
        ),
    )


def slanted_problem(d):
    """Values, vector and basis of a body on a slanted roller that touches the contact set"""
    values = parameters(d)
    system = jc.discretize(scene_of(values, {}))
    held = dict.fromkeys(np.unique(MESHES[d].facets["left"]), SLANTED[d])
    return values, system, allowed_motions(system, held)


@pytest.mark.parametrize("d", [2, pytest.param(3, marks=SLOW)])
def test_slanted_rollers_equal_an_elimination_by_an_independent_program(d):
    values, system, Q = slanted_problem(d)
    body = independent.Body(
        *(Q.T @ x.to_scipy().toarray() @ Q for x in (system.mass, system.stiffness)),
        viscosity=Q.T @ system.viscosity.to_scipy().toarray() @ Q,
        nodal_mass=None,
        normals=system.normals.to_scipy().toarray() @ Q,
        gap=np.asarray(system.gap),
        free=None,
        dimension=d,
    )
    start = initial_of(values)
    loads = (
        np.asarray(jax.vmap(system.control_load)(values["control"])) + np.asarray(system.load)
    ) @ Q
    y0, v0 = (np.ravel(x) @ Q for x in (start.displacement, start.velocity))
    other = independent.simulate(body, DT, loads, y0, v0)
    stepper = prepared(values, {"left": 2.0 * SLANTED[d]})
    motion = jc.simulate(stepper, values["control"], initial=start)
    assert np.any(motion.active)
    shape = motion.displacement.shape
    np.testing.assert_allclose(motion.displacement, (other.y @ Q.T).reshape(shape), atol=ROUNDING)
    np.testing.assert_allclose(motion.contact_impulse, other.impulse, atol=ROUNDING)


@pytest.mark.parametrize("scheme", ON_ANY_SYSTEM)
def test_rollers_equal_an_elimination_in_every_scheme(scheme):
    values, system, Q = slanted_problem(2)
    start, control = initial_of(values), values["control"]
    other = jc.prepare(eliminated(system, Q), DT, scheme=scheme)
    expected = jc.simulate(other, control, initial=start)
    motion = jc.simulate(
        prepared(values, {"left": SLANTED[2]}, scheme=scheme), control, initial=start
    )
    assert np.any(motion.active)
    np.testing.assert_allclose(motion.displacement, expected.displacement, atol=ROUNDING)
    np.testing.assert_allclose(motion.velocity, expected.velocity, atol=100.0 * ROUNDING)
    np.testing.assert_allclose(motion.gap, expected.gap, atol=ROUNDING)


@pytest.mark.parametrize(
    "scheme", [*SCHEMES[:1], SCHEMES[2], *(pytest.param(SCHEMES[k], marks=SLOW) for k in (1, 3, 4))]
)
def test_energy_balances_on_rollers(scheme):
    values = parameters(2)
    stepper = prepared(values, {"left": None, "right": np.array([1.0, 0.0])}, scheme=scheme)
    motion = jc.simulate(stepper, values["control"], initial=initial_of(values))
    ledger = jc.energy(stepper, motion, values["control"])
    assert np.any(motion.active)
    assert np.max(np.abs(ledger.residual)) < ROUNDING * np.max(ledger.total)
    sides = np.unique(np.concatenate([MESHES[2].facets[name] for name in ("left", "right")]))
    assert np.all(np.asarray(motion.displacement)[:, sides, 0] == 0.0)


def mirrored(mesh):
    """The mesh with its image at x = 0, where it has nodes, and which node is the image of which"""
    is_middle = mesh.points[:, 0] == 0.0
    image = np.where(is_middle, np.arange(mesh.n_nodes), -1)
    image[~is_middle] = mesh.n_nodes + np.arange(np.count_nonzero(~is_middle))
    points = np.concatenate([mesh.points, mesh.points[~is_middle] * [-1.0, 1.0]])
    flip = np.array([0, 2, 1])
    cells = np.concatenate([mesh.cells, image[mesh.cells][:, flip]])
    bottom = np.concatenate([mesh.facets["bottom"], image[mesh.facets["bottom"]]])
    return jc.Mesh.from_arrays(points, cells, {"bottom": bottom}), image


@pytest.mark.parametrize("scheme", ON_ANY_SYSTEM)
def test_half_a_body_on_its_plane_of_symmetry_moves_like_the_whole(scheme):
    half = MESHES[2]
    whole, image = mirrored(half)
    material = jc.KelvinVoigt(young=100.0, poisson=0.3, bulk_viscosity=0.2, shear_viscosity=0.1)
    ball = jc.Ball(np.array([0.0, -2.05]), 2.0)
    fall = np.array([0.0, -1.2])

    def motion(mesh, rollers):
        scene = jc.Scene(mesh, material, rollers=rollers, contact={"bottom": ball})
        stepper = jc.prepare(jax.jit(lambda: jc.discretize(scene))(), DT, scheme=scheme)
        speed = jnp.broadcast_to(jnp.asarray(fall), mesh.points.shape)
        return jc.simulate(stepper, steps=40, initial=jc.State(0.0 * speed, speed))

    part, full = motion(half, {"left": None}), motion(whole, {})
    assert np.any(part.active)
    y = np.asarray(full.displacement)
    np.testing.assert_allclose(part.displacement, y[:, : half.n_nodes], atol=ROUNDING)
    np.testing.assert_allclose(y[:, image] * [-1.0, 1.0], y[:, : half.n_nodes], atol=ROUNDING)


@pytest.mark.parametrize(
    "solver",
    [jc.ConjugateGradient(), pytest.param(jc.NestedDissection(leaf_size=8), marks=SLOW)],
)
def test_rollers_work_with_every_linear_solver(solver):
    values = parameters(2)
    rollers = {"left": SLANTED[2]}
    motions = [
        jc.simulate(
            prepared(values, rollers, linear_solver=x), steps=STEPS, initial=initial_of(values)
        )
        for x in (jc.Dense(), solver)
    ]
    np.testing.assert_allclose(motions[1].displacement, motions[0].displacement, atol=1e-9)


def test_rollers_work_in_single_precision():
    values = parameters(2)
    rollers = {"left": SLANTED[2]}
    double, single = (
        jc.simulate(prepared(values, rollers, dtype), steps=STEPS, initial=initial_of(values))
        for dtype in (jnp.float64, jnp.float32)
    )
    assert single.displacement.dtype == jnp.float32
    np.testing.assert_allclose(single.displacement, double.displacement, atol=2e-5)


def test_derivative_by_node_positions_and_direction_is_right():
    values = parameters(2)

    @jax.jit
    def objective(points, vector):
        changed = values | {"points": points}
        scene = scene_of(changed, {"left": vector, "right": None})
        stepper = jc.prepare(jc.discretize(scene), DT)
        return cost(jc.simulate(stepper, steps=STEPS, initial=initial_of(changed)))

    at = (values["points"], jnp.asarray(SLANTED[2]))
    report = jc.check_gradient(lambda x: objective(*x), at)
    assert report.verdict == jc.Verdict.RIGHT, report
    assert np.all(np.abs(report.order - 2.0) < 0.1)
    direct = [objective(at[0], v * jnp.asarray(SLANTED[2])) for v in (1.0, 2.0)]
    np.testing.assert_allclose(direct[0], direct[1], rtol=1e-12)


def test_edge_of_a_roller_set_is_held_in_both_directions():
    mesh = MESHES[2]
    corner = np.concatenate([mesh.facets["left"], mesh.facets["bottom"]])
    one_set = jc.Mesh.from_arrays(mesh.points, mesh.cells, mesh.facets | {"corner": corner})
    rows = [
        jc.discretize(jc.Scene(one_set, RUBBER, rollers=rollers)).rollers
        for rollers in (
            {"corner": None},
            {"left": None, "bottom": None},
            {"left": np.array([-3.0, 0.0]), "bottom": np.array([0.0, 2.0])},
        )
    ]
    products = [x.to_scipy().toarray().T @ x.to_scipy().toarray() for x in rows]
    n_held = len(np.unique(mesh.facets["left"])) + len(np.unique(mesh.facets["bottom"]))
    assert [x.count for x in rows] == [n_held] * 3
    for product in products[1:]:
        np.testing.assert_allclose(product, products[0], atol=1e-15)


def test_nodes_of_a_curved_set_are_held_in_one_direction():
    mesh = jc.meshes.disc(1.0, h=0.25)
    name = next(iter(mesh.facets))
    system = jc.discretize(jc.Scene(mesh, RUBBER, rollers={name: None}))
    nodes = np.unique(mesh.facets[name])
    assert system.rollers.count == len(nodes)
    along = np.sum(np.asarray(system.rollers.weights) * mesh.points[nodes], axis=1)
    np.testing.assert_allclose(along, 1.0, atol=1e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_block_between_rollers_is_stretched_uniformly(d):
    mesh = MESHES[d]
    young, poisson, pull = 3.0, 0.3, 0.12 * up(d)
    names = ("left", "bottom") if d == 2 else ("left", "front", "bottom")
    scene = jc.Scene(
        mesh,
        jc.KelvinVoigt(young=young, poisson=poisson),
        rollers=dict.fromkeys(names),
        traction={"top": pull},
    )
    result = jc.solve_static(jc.discretize(scene))
    stretch = 0.12 / young * (1.0 - poisson**2 if d == 2 else 1.0)
    shrink = 0.12 / young * poisson * (1.0 + poisson if d == 2 else 1.0)
    factors = np.append(np.full(d - 1, -shrink), stretch)
    np.testing.assert_allclose(result.displacement, mesh.points * factors, atol=1e-13)


def test_batch_over_the_direction_of_a_roller():
    values = parameters(2)
    vectors = jnp.stack([jnp.asarray(SLANTED[2]), jnp.array([1.0, 0.0])])

    def final(vector):
        stepper = jc.prepare(jc.discretize(scene_of(values, {"left": vector})), DT)
        return jc.simulate(stepper, steps=STEPS, initial=initial_of(values)).displacement[-1]

    batch = jax.jit(jax.vmap(final))(vectors)
    single = jax.jit(final)
    for row, vector in zip(batch, vectors, strict=True):
        np.testing.assert_allclose(row, single(vector), atol=ROUNDING)


@pytest.mark.parametrize(
    ("rollers", "message"),
    [
        ({"lft": None}, r"'lft' is not in the mesh.*'left'"),
        ({"left": np.ones(3)}, r"rollers\['left'\] must have shape \(2,\)"),
        ({"left": np.array([np.nan, 1.0])}, r"rollers\['left'\] must be finite"),
        ({"left": np.zeros(2)}, r"rollers\['left'\] must not be the zero vector"),
        ({"bottom": np.array([0.04, -1.0])}, r"'bottom'\] hold 5 nodes.*contact normals.*row of"),
    ],
)
def test_wrong_rollers_are_refused(rollers, message):
    values = parameters(2)
    values["obstacle"]["normal"] = jnp.array([-0.04, 1.0])
    with pytest.raises(ValueError, match=message):
        jc.discretize(scene_of(values, rollers))


def test_reduced_model_on_rollers_moves_as_the_full_one():
    stepper = prepared(parameters(2), {"left": SLANTED[2]})
    system = stepper.system
    # With the responses to contact that is all that the rollers allow.
    n_allowed = system.size - system.rollers.count
    reduced = jc.reduce(system, modes=n_allowed - 1)
    assert reduced.size == n_allowed
    thrown = initial_of(parameters(2)).velocity
    start = jc.State(velocity=system.lift(hold(system.rollers, system.restrict(thrown))))
    found, expected = (
        jc.simulate(x, steps=STEPS, initial=start) for x in (jc.prepare(reduced, DT), stepper)
    )
    assert np.any(expected.active)
    size = np.max(np.abs(expected.displacement))
    np.testing.assert_allclose(found.displacement, expected.displacement, atol=1e-10 * size)
    few = jc.reduce(system, modes=2)
    assert np.max(np.abs(system.rollers @ few.basis.vectors[:, 0])) < ROUNDING
