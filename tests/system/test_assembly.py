import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.sparse.linalg
from support.independent import assemble

import jaxcontact as jc

# Sums of a few dozen products, relative to the largest of them.
ROUNDING = 1e-12
SMALL_MESHES = {
    1: jc.meshes.interval(2.0, h=0.5),
    2: jc.meshes.rectangle((2.0, 1.0), h=0.5),
    3: jc.meshes.box((1.0, 1.0, 1.0), h=0.5),
}
VOLUMES = {1: 2.0, 2: 2.0, 3: 1.0}
MATERIAL = jc.KelvinVoigt(
    young=7.0, poisson=0.3, bulk_viscosity=2.0, shear_viscosity=3.0, density=5.0
)
LAMBDA, MU = 7.0 * 0.3 / (1.3 * 0.4), 7.0 / 2.6


def irregular(dimension, seed=0):
    """The small mesh with its inner nodes moved, so that no two cells are alike"""
    mesh = SMALL_MESHES[dimension]
    inner = np.ones(mesh.n_nodes, bool)
    inner[np.unique(np.concatenate([f.ravel() for f in mesh.facets.values()]))] = False
    assert inner.any()
    moves = np.random.default_rng(seed).uniform(-0.06, 0.06, mesh.points.shape)
    return mesh.with_points(mesh.points + np.where(inner[:, None], moves, 0.0)), inner


def linear_field(mesh, seed=1):
    """A displacement with constant gradient: the field (N, d) and the gradient (d, d)"""
    gradient = np.random.default_rng(seed).normal(size=(mesh.dimension, mesh.dimension))
    return np.asarray(mesh.points) @ gradient.T + 1.0, gradient


def rigid_motions(points):
    """Translations and rotations as columns (N d, 1 | 3 | 6)"""
    d = points.shape[1]
    motions = [np.broadcast_to(row, points.shape) for row in np.eye(d)]
    for i in range(d):
        for j in range(i):
            rotation = np.zeros((d, d))
            rotation[i, j], rotation[j, i] = 1.0, -1.0
            motions.append(points @ rotation.T)
    return np.stack([motion.ravel() for motion in motions], axis=1)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_stiffness_passes_the_patch_test(dimension):
    mesh, inner = irregular(dimension)
    A = jc.discretize(jc.Scene(mesh, MATERIAL)).stiffness.to_scipy()
    field, _ = linear_field(mesh)
    u = field.ravel()
    inside = np.repeat(inner, dimension)
    # The boundary is given; the inner nodes must find the linear field.
    found = u.copy()
    found[inside] = scipy.sparse.linalg.spsolve(
        A[inside][:, inside].tocsc(), -A[inside][:, ~inside] @ u[~inside]
    )
    np.testing.assert_allclose(found, u, atol=ROUNDING)


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize("name", ["stiffness", "viscosity"])
def test_isotropic_form_has_exactly_the_rigid_motions_in_its_kernel(dimension, name):
    mesh, _ = irregular(dimension)
    matrix = getattr(jc.discretize(jc.Scene(mesh, MATERIAL)), name).to_scipy().toarray()
    motions = rigid_motions(mesh.points)
    assert np.max(np.abs(matrix @ motions)) < ROUNDING * np.max(np.abs(matrix))
    eigenvalues = np.linalg.eigvalsh(matrix)
    # The lowest mode of vibration of a body of a few cells is far from zero.
    assert np.sum(eigenvalues < 1e-3 * eigenvalues[-1]) == motions.shape[1]
    assert eigenvalues[0] > -ROUNDING * eigenvalues[-1]


@pytest.mark.parametrize("dimension", [1, 2, 3])
@pytest.mark.parametrize(
    ("name", "first", "second"),
    [("stiffness", LAMBDA, MU), ("viscosity", 2.0 - 2.0 * 3.0 / 3.0, 3.0)],
)
def test_isotropic_form_of_a_linear_field_is_stress_times_strain(dimension, name, first, second):
    mesh, _ = irregular(dimension)
    matrix = getattr(jc.discretize(jc.Scene(mesh, MATERIAL)), name).to_scipy()
    field, gradient = linear_field(mesh)
    strain = (gradient + gradient.T) / 2
    density = first * np.trace(strain) ** 2 + 2 * second * np.sum(strain**2)
    energy = field.ravel() @ (matrix @ field.ravel())
    np.testing.assert_allclose(energy, VOLUMES[dimension] * density, rtol=ROUNDING)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_matrices_are_symmetric(dimension):
    mesh, _ = irregular(dimension)
    system = jc.discretize(jc.Scene(mesh, MATERIAL))
    for matrix in (system.mass, system.stiffness, system.viscosity, system.l2_mass):
        matrix = matrix.to_scipy()
        assert abs(matrix - matrix.T).max() < ROUNDING * abs(matrix).max()


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_mass_of_each_component_sums_to_density_times_volume(dimension):
    mesh, _ = irregular(dimension)
    system = jc.discretize(jc.Scene(mesh, MATERIAL))
    translations = rigid_motions(mesh.points)[:, :dimension]
    total = VOLUMES[dimension] * np.eye(dimension)
    for matrix, factor in ((system.mass, 5.0), (system.l2_mass, 1.0)):
        summed = translations.T @ (matrix.to_scipy() @ translations)
        np.testing.assert_allclose(summed, factor * total, atol=ROUNDING)
    np.testing.assert_allclose(system.nodal_mass.to_scipy().sum(), VOLUMES[dimension])


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_mass_integrates_products_of_linear_functions_exactly(dimension):
    mesh = SMALL_MESHES[dimension]
    x = np.asarray(mesh.points)[:, 0]
    mass = jc.discretize(jc.Scene(mesh, MATERIAL)).nodal_mass.to_scipy()
    length = x.max()
    np.testing.assert_allclose(
        x @ mass @ x, VOLUMES[dimension] * length**2 / 3, rtol=ROUNDING
    )  # the integral of x^2


def test_system_equals_the_independently_assembled_one():
    scene = jc.scenes.half_disc(h=15 / 4)
    system = jc.discretize(scene)
    mesh = scene.mesh
    nodes = np.unique(mesh.facets["contact"])
    contact = [(i, np.array([0.0, -1.0]), mesh.points[i, 1] + 15.8) for i in nodes]
    body = assemble(
        mesh.points, mesh.cells, np.unique(mesh.facets["clamped"]), contact,
        young=1e8, poisson=0.3, bulk=1e4, shear=1e4,
    )  # fmt: skip
    for ours, theirs in (
        (system.mass, body.mass),
        (system.stiffness, body.stiffness),
        (system.viscosity, body.viscosity),
        (system.nodal_mass, body.nodal_mass),
    ):
        scale = np.max(np.abs(theirs))
        np.testing.assert_allclose(ours.to_scipy().toarray(), theirs, atol=ROUNDING * scale)
    np.testing.assert_array_equal(system.contact_nodes, nodes)
    np.testing.assert_allclose(system.normals.to_scipy().toarray(), body.normals)
    np.testing.assert_allclose(system.gap, body.gap, rtol=ROUNDING)


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_body_force_has_the_right_sum_and_first_moments(dimension):
    mesh, _ = irregular(dimension)
    force = np.arange(1.0, dimension + 1)
    system = jc.discretize(jc.Scene(mesh, MATERIAL, body_force=force))
    load = np.asarray(system.lift(system.load))
    moments = load.T @ np.asarray(mesh.points)
    center = np.asarray(mesh.points).max(axis=0) / 2
    np.testing.assert_allclose(load.sum(axis=0), VOLUMES[dimension] * force, rtol=ROUNDING)
    expected = VOLUMES[dimension] * np.outer(force, center)
    np.testing.assert_allclose(moments, expected, rtol=ROUNDING)


def test_body_force_is_the_load_of_the_same_constant_control():
    mesh, _ = irregular(2)
    force = np.array([1.0, -2.0])
    scene = jc.Scene(mesh, MATERIAL, clamped=("left",), body_force=force)
    system = jc.discretize(scene)
    control = jnp.broadcast_to(jnp.asarray(force), (mesh.n_nodes, 2))
    np.testing.assert_allclose(system.control_load(control), system.load, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("dimension", "side", "area", "center"),
    [
        (1, "right", 1.0, [2.0]),
        (2, "right", 1.0, [2.0, 0.5]),
        (2, "top", 2.0, [1.0, 1.0]),
        (3, "top", 1.0, [0.5, 0.5, 1.0]),
    ],
)
def test_traction_has_the_right_sum_and_first_moments(dimension, side, area, center):
    mesh = SMALL_MESHES[dimension]
    traction = np.arange(1.0, dimension + 1)
    system = jc.discretize(jc.Scene(mesh, MATERIAL, traction={side: traction}))
    load = np.asarray(system.lift(system.load))
    np.testing.assert_allclose(load.sum(axis=0), area * traction, rtol=ROUNDING)
    moments = load.T @ np.asarray(mesh.points)
    np.testing.assert_allclose(moments, area * np.outer(traction, center), rtol=ROUNDING)


def test_traction_on_a_curved_side_acts_on_its_polygon():
    mesh = jc.meshes.half_disc(3.0, h=1.0)
    system = jc.discretize(jc.Scene(mesh, MATERIAL, traction={"contact": np.array([1.0, 0.0])}))
    # Three chords of the circle, each seen under 20 degrees.
    length = 3 * 2 * 3.0 * np.sin(np.pi / 18)
    np.testing.assert_allclose(np.sum(system.load), length, rtol=ROUNDING)


def test_load_on_clamped_nodes_is_left_out():
    mesh = SMALL_MESHES[1]
    scene = jc.Scene(mesh, MATERIAL, clamped=("left",), body_force=np.array([1.0]))
    # The clamped end would carry half a cell.
    np.testing.assert_allclose(np.sum(jc.discretize(scene).load), 2.0 - 0.25, rtol=ROUNDING)


def two_halves(left, right):
    mesh = SMALL_MESHES[1]
    mesh = jc.Mesh.from_arrays(
        mesh.points, mesh.cells, mesh.facets, {"soft": [0, 1], "stiff": [2, 3]}
    )
    return jc.Scene(
        mesh,
        {"stiff": right, "soft": left},
        clamped=("left",),
        traction={"right": np.array([2.0])},
    )


def test_regions_in_series_stretch_by_their_own_stiffness():
    soft = jc.KelvinVoigt(young=1.0, poisson=0.0)
    stiff = jc.KelvinVoigt(young=10.0, poisson=0.0, density=3.0, shear_viscosity=1.0)
    system = jc.discretize(two_halves(soft, stiff))
    y = np.linalg.solve(system.stiffness.to_scipy().toarray(), np.asarray(system.load))
    np.testing.assert_allclose(y, [1.0, 2.0, 2.1, 2.2], rtol=ROUNDING)


def test_regions_carry_their_own_density_and_viscosity():
    light = jc.KelvinVoigt(young=1.0, poisson=0.0)
    heavy = jc.KelvinVoigt(young=1.0, poisson=0.0, density=3.0, shear_viscosity=1.0)
    system = jc.discretize(two_halves(light, heavy))
    x = np.array([0.5, 1.0, 1.5, 2.0])
    # The integrals of rho x^2 and of (4/3 G) over the two halves.
    mass = 1.0 / 3.0 + 3.0 * (8.0 - 1.0) / 3.0
    np.testing.assert_allclose(x @ (system.mass.to_scipy() @ x), mass, rtol=ROUNDING)
    np.testing.assert_allclose(x @ (system.viscosity.to_scipy() @ x), 4.0 / 3.0, rtol=ROUNDING)


def test_equal_regions_are_one_material():
    system = jc.discretize(two_halves(MATERIAL, MATERIAL))
    single = jc.discretize(jc.Scene(SMALL_MESHES[1], MATERIAL, clamped=("left",)))
    for name in ("mass", "stiffness", "viscosity"):
        ours, theirs = (getattr(s, name).to_scipy().toarray() for s in (system, single))
        np.testing.assert_allclose(ours, theirs, rtol=ROUNDING)


def test_material_per_cell_is_that_of_its_regions():
    soft = jc.KelvinVoigt(young=1.0, poisson=0.1)
    stiff = jc.KelvinVoigt(young=10.0, poisson=0.1, density=3.0, shear_viscosity=1.0)
    regions = jc.discretize(two_halves(soft, stiff))
    cellwise = jc.KelvinVoigt(
        young=[1.0, 1.0, 10.0, 10.0],
        poisson=0.1,
        density=jnp.array([1.0, 1.0, 3.0, 3.0]),
        shear_viscosity=np.array([0.0, 0.0, 1.0, 1.0]),
    )
    system = jc.discretize(jc.Scene(SMALL_MESHES[1], cellwise, clamped=("left",)))
    for name in ("mass", "stiffness", "viscosity"):
        ours, theirs = (getattr(s, name).to_scipy().toarray() for s in (system, regions))
        np.testing.assert_allclose(ours, theirs, rtol=ROUNDING)


def test_material_per_cell_has_a_derivative_by_each_cell():
    mesh = SMALL_MESHES[2]
    field, gradient = linear_field(mesh)
    field = jnp.asarray(field.ravel())

    def energy(young):
        material = jc.KelvinVoigt(young=young, poisson=0.0)
        return jnp.dot(field, jc.discretize(jc.Scene(mesh, material)).stiffness @ field)

    strain = (gradient + gradient.T) / 2
    # Cells are right triangles with legs of 1/2, the energy density is young times strain squared.
    expected = np.full(mesh.n_cells, np.sum(strain**2) / 8)
    found = jax.jit(jax.grad(energy))(jnp.linspace(1.0, 2.0, mesh.n_cells))
    np.testing.assert_allclose(found, expected, rtol=ROUNDING)


@pytest.mark.parametrize(
    ("young", "message"),
    [
        (np.ones(3), r"scalar or have one value per cell, \(4,\), got shape \(3,\).*region"),
        ([1.0, -2.0, 1.0, 0.0], r"young must be positive, got -2.0 in 2 cells, first \[1, 3\]"),
    ],
)
def test_material_per_cell_that_does_not_fit_is_named(young, message):
    material = jc.KelvinVoigt(young=young, poisson=0.3)
    with pytest.raises(ValueError, match=message):
        jc.discretize(jc.Scene(SMALL_MESHES[1], material))


def test_material_of_a_region_is_a_scalar():
    cellwise = jc.KelvinVoigt(young=np.ones(4), poisson=0.3)
    with pytest.raises(ValueError, match=r"must be a scalar, got shape \(4,\)"):
        jc.discretize(two_halves(cellwise, MATERIAL))


def test_system_without_viscosity_assembles_none():
    elastic = jc.KelvinVoigt(young=1.0, poisson=0.3)
    assert jc.discretize(jc.Scene(SMALL_MESHES[2], elastic)).viscosity is None


def test_lift_is_zero_on_clamped_nodes_and_undone_by_restrict():
    mesh = SMALL_MESHES[2]
    system = jc.discretize(jc.Scene(mesh, MATERIAL, clamped=("left", "top")))
    x = jnp.arange(1.0, 1.0 + 6 * system.size).reshape(2, 3, system.size)
    field = system.lift(x)
    clamped = np.unique(np.concatenate([mesh.facets["left"].ravel(), mesh.facets["top"].ravel()]))
    assert field.shape == (2, 3, mesh.n_nodes, 2)
    assert system.size == 2 * (mesh.n_nodes - clamped.size)
    assert not np.any(field[..., clamped, :])
    np.testing.assert_array_equal(system.restrict(field), x)


def contact_system(obstacle, side="bottom"):
    return jc.discretize(jc.Scene(SMALL_MESHES[2], MATERIAL, contact={side: obstacle}))


def test_contact_with_a_slanted_half_space_has_its_distance_and_normal():
    point, normal = np.array([0.0, -1.0]), np.array([3.0, 4.0])
    system = contact_system(jc.HalfSpace(point, normal))
    x = SMALL_MESHES[2].points[system.contact_nodes]
    np.testing.assert_allclose(system.gap, (x - point) @ normal / 5.0, rtol=ROUNDING)
    expected = np.broadcast_to([-0.6, -0.8], x.shape)
    np.testing.assert_allclose(system.normals.weights, expected, rtol=ROUNDING)


def test_contact_with_a_ball_points_to_its_center():
    center = np.array([0.7, -2.0])
    system = contact_system(jc.Ball(center, 1.5))
    rays = center - SMALL_MESHES[2].points[system.contact_nodes]
    distance = np.linalg.norm(rays, axis=1)
    np.testing.assert_allclose(system.gap, distance - 1.5, rtol=ROUNDING)
    np.testing.assert_allclose(system.normals.weights, rays / distance[:, None], rtol=ROUNDING)


def test_contact_with_a_signed_distance_equals_the_obstacle_that_it_describes():
    center = np.array([0.7, -2.0])
    ball = contact_system(jc.Ball(center, 1.5))
    same = contact_system(jc.SignedDistance(lambda x: jnp.linalg.norm(x - center) - 1.5))
    np.testing.assert_allclose(same.gap, ball.gap, rtol=ROUNDING)
    np.testing.assert_allclose(same.normals.weights, ball.normals.weights, rtol=ROUNDING)


def test_contact_gap_is_the_distance_that_a_displacement_along_the_normal_closes():
    obstacle = jc.Ball(np.array([0.7, -2.0]), 1.5)
    system = contact_system(obstacle)
    x = SMALL_MESHES[2].points[system.contact_nodes]
    moved = x + np.asarray(system.gap)[:, None] * np.asarray(system.normals.weights)
    distance = jax.vmap(obstacle.signed_distance)(jnp.asarray(moved))
    np.testing.assert_allclose(distance, 0.0, atol=ROUNDING)


def test_contact_area_sums_to_the_size_of_the_set():
    floor = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    np.testing.assert_allclose(
        contact_system(floor).contact_area, [0.25, 0.5, 0.5, 0.5, 0.25], rtol=ROUNDING
    )
    solid = jc.HalfSpace(np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0]))
    cube = jc.discretize(jc.Scene(SMALL_MESHES[3], MATERIAL, contact={"bottom": solid}))
    np.testing.assert_allclose(np.sum(cube.contact_area), 1.0, rtol=ROUNDING)


def test_contact_normals_act_on_the_unknowns_of_their_node():
    floor = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    scene = jc.Scene(SMALL_MESHES[2], MATERIAL, clamped=("top",), contact={"bottom": floor})
    system = jc.discretize(scene)
    field = np.random.default_rng(0).normal(size=(SMALL_MESHES[2].n_nodes, 2))
    found = system.normals @ system.restrict(jnp.asarray(field))
    np.testing.assert_allclose(found, -field[system.contact_nodes, 1], rtol=ROUNDING)


def test_contact_normals_of_a_system_know_its_unknowns():
    floor = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    scene = jc.Scene(SMALL_MESHES[2], MATERIAL, clamped=("top",), contact={"bottom": floor})
    system = jc.discretize(scene)
    assert system.normals.to_scipy().shape == (5, system.size)


def test_system_with_another_gap_changes_nothing_else():
    system = contact_system(jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0])))
    moved = system.with_gap(np.full(5, 0.25))
    np.testing.assert_array_equal(moved.gap, 0.25)
    for ours, theirs in zip(
        jax.tree.leaves(moved.with_gap(system.gap)), jax.tree.leaves(system), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)
    np.testing.assert_array_equal(
        jax.jacobian(lambda g: system.with_gap(g).gap)(system.gap), np.eye(5)
    )
    with pytest.raises(ValueError, match=r"gap has shape \(\); pass \(5,\), one for each"):
        system.with_gap(0.25)


def test_contact_corner_in_two_sets_makes_two_pairs():
    floor = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    wall = jc.HalfSpace(np.array([-2.0, 0.0]), np.array([1.0, 0.0]))
    mesh = SMALL_MESHES[2]
    system = jc.discretize(jc.Scene(mesh, MATERIAL, contact={"left": wall, "bottom": floor}))
    (corner,) = np.flatnonzero(np.all(mesh.points == 0.0, axis=1))
    pairs = np.flatnonzero(system.contact_nodes == corner)
    np.testing.assert_allclose(np.sort(system.gap[pairs]), [1.0, 2.0], rtol=ROUNDING)


@pytest.mark.parametrize("dimension", [1, 2])
def test_static_solution_converges_with_order_two(dimension):
    """-div sigma(u) = f with u_i = i prod_j sin(pi x_j), clamped all around"""

    def exact(x):
        return jnp.prod(jnp.sin(jnp.pi * x)) * jnp.arange(1.0, dimension + 1)

    def force(x):
        hessian = jax.hessian(exact)(x)  # (i, j, k): d_j d_k u_i
        laplacian = jnp.einsum("ijj->i", hessian)
        return -MU * laplacian - (LAMBDA + MU) * jnp.einsum("jji->i", hessian)

    def error(n):
        mesh = jc.meshes.interval(1.0, h=1 / n)
        if dimension == 2:
            mesh = jc.meshes.rectangle((1.0, 1.0), h=1 / n)

        @jax.jit  # one program instead of one for each operation
        def system_and_load(points):
            scene = jc.Scene(mesh.with_points(points), MATERIAL, clamped=tuple(mesh.facets))
            system = jc.discretize(scene)
            return system, system.control_load(jax.vmap(force)(points))

        system, load = system_and_load(jnp.asarray(mesh.points))
        y = scipy.sparse.linalg.spsolve(system.stiffness.to_scipy().tocsc(), np.asarray(load))
        field = np.asarray(system.lift(jnp.asarray(y)))
        # Midpoints of the edges (1D: of the cells) see the L2 error to the leading order.
        first, second = np.tril_indices(dimension + 1, -1)
        i, j = mesh.cells[:, first], mesh.cells[:, second]
        middle = jnp.asarray(mesh.points[i] + mesh.points[j]).reshape(-1, dimension) / 2
        difference = (field[i] + field[j]).reshape(-1, dimension) / 2 - jax.vmap(exact)(middle)
        return np.sqrt(np.mean(np.sum(difference**2, axis=1)))  # all cells are equal

    errors = np.array([error(n) for n in (6, 12, 24)])
    rates = np.log2(errors[:-1] / errors[1:])
    assert np.all(np.abs(rates - 2.0) < 0.1), rates
    # 1D: u_h - u = -(h^2/8 + h^2/12) u'' at the midpoints, by interpolation of u and of f.
    # 2D: measured 5.6 h^2. Both bounds leave five per cent.
    bound = {1: 1.05 * (1 / 8 + 1 / 12) * np.pi**2 / np.sqrt(2), 2: 1.05 * 5.6}[dimension]
    assert errors[-1] * 24**2 < bound, errors * 24**2


def test_discretize_under_jit_equals_discretize():
    mesh = SMALL_MESHES[2]

    def matrices(material, point):
        obstacle = jc.HalfSpace(point, jnp.array([0.0, 1.0]))
        system = jc.discretize(jc.Scene(mesh, material, contact={"bottom": obstacle}))
        mass = system.mass.scalar.values
        return system.stiffness.values, system.viscosity.values, mass, system.gap

    point = jnp.array([0.0, -1.0])
    for traced, eager in zip(
        jax.jit(matrices)(MATERIAL, point), matrices(MATERIAL, point), strict=True
    ):
        np.testing.assert_allclose(traced, eager, rtol=ROUNDING, atol=ROUNDING)


def test_discretize_is_differentiable_by_the_material():
    mesh, _ = irregular(2)
    field = jnp.asarray(linear_field(mesh)[0].ravel())

    def energy(poisson):
        material = jc.KelvinVoigt(young=7.0, poisson=poisson)
        return jnp.dot(field, jc.discretize(jc.Scene(mesh, material)).stiffness @ field)

    difference = (energy(0.3 + 1e-5) - energy(0.3 - 1e-5)) / 2e-5
    # Error of the difference quotient: third derivatives times 1e-10.
    np.testing.assert_allclose(jax.grad(energy)(0.3), difference, rtol=1e-8)


def test_discretize_is_differentiable_by_the_node_positions():
    mesh = SMALL_MESHES[2]

    def total_mass(scale):
        scaled = mesh.with_points(scale * jnp.asarray(mesh.points))
        return jnp.sum(jc.discretize(jc.Scene(scaled, MATERIAL)).nodal_mass.values)

    # The area is 2 scale^2.
    np.testing.assert_allclose(jax.grad(total_mass)(1.5), 4 * 1.5, rtol=ROUNDING)


def test_discretize_in_float32_makes_every_array_float32():
    floor = jc.HalfSpace(np.array([0.0, -1.0]), np.array([0.0, 1.0]))
    scene = jc.Scene(
        SMALL_MESHES[2],
        MATERIAL,
        clamped=("top",),
        contact={"bottom": floor},
        body_force=np.array([0.0, -1.0]),
    )
    leaves = jax.tree.leaves(jc.discretize(scene, dtype=jnp.float32))
    expected = {np.dtype("float32"), np.dtype("int32"), np.dtype(bool)}
    assert {leaf.dtype for leaf in leaves} == expected
