"""The exact solutions against independent computations in plain NumPy.

Bars: the invariants u_t + c u_x and u_t - c u_x of the wave equation move by one cell per step of
h/c, which reproduces d'Alembert's solution exactly if contacts begin and end with a step. There
velocity is exact at (x_j, t_n+1/2) and strain at (x_j+1/2, t_n), half a cell away from every front.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxcontact.reference import (
    BouncingMass,
    ClampedBar,
    FallingBar,
    FreeBar,
    Hertz,
    first_touch_loss,
)

N = 12  # cells; the number does not matter for the accuracy
ROUNDING = 1e-11  # relative to quantities of size 1 to 1000, over some hundred steps


def characteristics(bar, velocity, strain, steps, gap=0.0, gravity=0.0, clamped=False):
    """Displacement (steps+1, N+1) and mean contact pressure per step (steps,), from u = 0."""
    c = np.sqrt(bar.young / bar.density)
    dt = bar.length / N / c
    u, pressure = np.zeros((steps + 1, N + 1)), np.zeros(steps)
    # Cell means of the invariants; on their way they lose g dt per step.
    left_going, right_going = np.ones((2, N)) * np.array(
        [[velocity + c * strain], [velocity - c * strain]]
    )
    for n in range(steps):
        half = gravity * dt / 2
        v = np.empty(N + 1)
        v[1:-1] = (left_going[1:] + right_going[:-1]) / 2 - half
        v[-1] = 0.0 if clamped else right_going[-1] - half
        free = left_going[0] - half
        v[0] = max(free, (-gap - u[n, 0]) / dt)
        pressure[n] = bar.density * c * (v[0] - free)
        u[n + 1] = u[n] + dt * v
        left_going, right_going = (
            np.append(left_going[1:] - 2 * half, 2 * v[-1] - right_going[-1]),
            np.append(2 * v[0] - left_going[0], right_going[:-1] - 2 * half),
        )
    return u, pressure


def clamped_case():
    bar = ClampedBar(young=4.0, density=0.25, length=3.0, amplitude=0.7)
    change, pressure = characteristics(bar, 0.0, -0.7 / 3, 8 * N, gap=0.7, clamped=True)
    return bar, (0.7 * (1 - np.arange(N + 1) / N) + change, pressure)


def free_case():
    return FreeBar(), characteristics(FreeBar(), -10.0, 0.0, 5 * N, gap=5.0)


def falling_case(start=36, steps=18 * N):
    """Falls during `start` steps of 1/36 s: 36 is periodic, others hold up to the next impact."""
    bar = FallingBar(gap=10.0 * (start / 36) ** 2 / 2)
    return bar, characteristics(bar, 0.0, 0.0, steps, gap=bar.gap, gravity=10.0)


CASES = {"clamped": clamped_case, "free": free_case, "falling": falling_case}
BARS = {"clamped": ClampedBar(amplitude=0.7), "free": FreeBar(), "falling": FallingBar()}


def grid(bar, steps):
    """Nodes (1, N+1) and times (steps+1, 1)."""
    h = bar.length / N
    dt = h / float(bar.wave_speed())
    return h * np.arange(N + 1.0)[None], dt * np.arange(steps + 1.0)[:, None], h, dt


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_bar_displacement_is_that_of_the_characteristics(case):
    bar, (u, _) = case()
    x, t, _, _ = grid(bar, len(u) - 1)
    np.testing.assert_allclose(bar.displacement(x, t), u, atol=ROUNDING)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_bar_velocity_is_the_time_difference_of_the_characteristics(case):
    bar, (u, _) = case()
    x, t, _, dt = grid(bar, len(u) - 1)
    velocity = bar.velocity(x, t[:-1] + dt / 2)
    np.testing.assert_allclose(velocity, np.diff(u, axis=0) / dt, atol=10 * ROUNDING)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_bar_strain_is_the_space_difference_of_the_characteristics(case):
    bar, (u, _) = case()
    x, t, h, _ = grid(bar, len(u) - 1)
    strain = bar.strain(x[:, :-1] + h / 2, t)
    np.testing.assert_allclose(strain, np.diff(u, axis=1) / h, atol=10 * ROUNDING)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_bar_contact_force_mean_is_that_of_the_characteristics(case):
    bar, (u, pressure) = case()
    _, t, _, _ = grid(bar, len(u) - 1)
    mean = bar.contact_force_mean(t[:-1, 0], t[1:, 0])
    np.testing.assert_allclose(mean, pressure, atol=1e-9)


@pytest.mark.parametrize("bar", BARS.values(), ids=BARS)
def test_bar_energies_are_the_quadrature_of_the_fields(bar):
    # Fronts lie at multiples of h/4, where the quadrature cells end: 3 Gauss points are exact.
    _, t, h, dt = grid(bar, 18 * N)
    t = t + dt / 4
    points, weights = np.polynomial.legendre.leggauss(3)
    x = ((np.arange(4 * N)[:, None] + (points + 1) / 2) * h / 4).reshape(1, -1)
    weights = np.tile(weights * h / 8, 4 * N)
    kinetic = bar.density / 2 * np.asarray(bar.velocity(x, t)) ** 2 @ weights
    elastic = bar.young / 2 * np.asarray(bar.strain(x, t)) ** 2 @ weights
    t = t[:, 0]
    tolerance = 1e-12 * float(bar.energy())  # a few thousand rounded terms
    np.testing.assert_allclose(bar.kinetic_energy(t), kinetic, atol=tolerance)
    np.testing.assert_allclose(bar.elastic_energy(t), elastic, atol=tolerance)
    total = kinetic + elastic
    if isinstance(bar, FallingBar):
        height = (bar.gap + np.asarray(bar.displacement(x, t[:, None]))) @ weights
        potential = bar.density * bar.gravity * height
        np.testing.assert_allclose(bar.potential_energy(t), potential, atol=tolerance)
        total = total + potential
    np.testing.assert_allclose(total, bar.energy(), rtol=1e-12)


@pytest.mark.parametrize("bar", [FreeBar(), FallingBar()], ids=["free", "falling"])
def test_bar_impulse_is_the_change_of_momentum(bar):
    _, t, h, dt = grid(bar, 18 * N)
    t = t + dt / 4
    x = (np.arange(4 * N)[None] + 0.5) * h / 4  # velocity is linear between the fronts
    momentum = bar.density * np.asarray(bar.velocity(x, t)).sum(axis=1) * h / 4
    start = -bar.density * bar.length * getattr(bar, "impact_speed", 0.0)
    weight = bar.density * bar.length * getattr(bar, "gravity", 0.0)
    t = t[:, 0]
    expected = momentum - start + weight * t
    np.testing.assert_allclose(bar.accumulated_impulse(t), expected, atol=1e-10)


@pytest.mark.parametrize("bar", BARS.values(), ids=BARS)
def test_bar_contact_force_mean_is_the_quadrature_of_the_force(bar):
    t = np.linspace(0.0, 5.0, 38)  # steps that match neither start nor end of a contact
    mean = np.asarray(bar.contact_force_mean(t[:-1], t[1:]))
    fine = t[:-1, None] + np.diff(t)[:, None] * (np.arange(4000) + 0.5) / 4000
    force = np.asarray(bar.contact_force(fine))
    # The midpoint rule misplaces each start and end by at most half of 1/4000.
    np.testing.assert_allclose(mean, force.mean(axis=1), atol=force.max() / 4000)
    assert ((mean > 0.05 * mean.max()) & (mean < 0.5 * mean.max())).any()


@pytest.mark.parametrize("bar", BARS.values(), ids=BARS)
def test_bar_satisfies_signorini_at_the_wall(bar):
    t = np.linspace(0.001, 20.0, 4001)
    gap = np.asarray(bar.displacement(0.0, t)) + getattr(bar, "gap", 0.0)
    force = np.asarray(bar.contact_force(t))
    assert gap.min() > -ROUNDING
    assert force.min() >= 0
    np.testing.assert_allclose(gap * force, 0, atol=1e-9)
    is_pressed = force > 0
    stress = np.asarray(bar.stress(0.0, t))
    np.testing.assert_allclose(force[is_pressed], -stress[is_pressed], rtol=1e-9)


def test_clamped_bar_starts_at_rest_with_the_prestrained_shape():
    bar, x = ClampedBar(), np.linspace(0, 1, 21)
    np.testing.assert_allclose(bar.displacement(x, 0.0), 0.5 * (1 - x), atol=1e-15)
    np.testing.assert_array_equal(bar.velocity(x, 0.0), 0)
    np.testing.assert_allclose(bar.displacement(1.0, np.linspace(0, 9, 50)), 0, atol=1e-15)


def test_clamped_bar_presses_with_half_a_pascal_on_the_middle_third_of_the_period():
    bar = ClampedBar()
    assert [float(time) for time in (*bar.contact_interval(), bar.period())] == [1, 2, 3]
    np.testing.assert_array_equal(
        bar.contact_force(np.array([0.9, 1.1, 1.9, 2.1, 4.5])) * 2, [0, 1, 1, 0, 1]
    )


def test_free_bar_presses_with_300_pascal_for_two_thirds_of_a_second():
    bar = FreeBar()
    np.testing.assert_allclose(bar.contact_interval(), (0.5, 7 / 6), rtol=1e-15)
    np.testing.assert_allclose(bar.contact_force(np.array([0.5, 1.16])), 300, rtol=1e-15)
    np.testing.assert_allclose(bar.impulse(), 200, rtol=1e-15)
    np.testing.assert_allclose(bar.velocity(np.linspace(0, 10, 7), 2.0), bar.rebound_velocity())


def test_falling_bar_presses_from_300_to_500_pascal_and_back_every_16_thirds_seconds():
    bar = FallingBar()
    np.testing.assert_allclose(bar.period(), 16 / 3, rtol=1e-14)
    np.testing.assert_allclose(bar.next_impact(), 11 / 3, rtol=1e-14)
    edges = np.array([1 + 1e-12, 5 / 3 - 1e-12, 11 / 3 + 1e-12, 13 / 3 - 1e-12])
    np.testing.assert_allclose(bar.contact_force(edges), [300, 500, 500, 300], rtol=1e-9)
    t = np.array([0.3, 1.2, 2.9, 3.8, 5.0])
    later = bar.displacement(4.0, t + 5 * bar.period())
    np.testing.assert_allclose(later, bar.displacement(4.0, t), atol=ROUNDING)


def test_falling_bar_separates_with_uniform_velocity_and_the_strain_of_its_weight():
    bar, x = FallingBar(), np.linspace(0.1, 10, 9)
    end = bar.contact_interval()[1] + 1e-13
    np.testing.assert_allclose(bar.velocity(x, end), bar.rebound_velocity(), rtol=1e-9)
    np.testing.assert_allclose(bar.strain(x, end), -2 * 10 / 900 * (10 - x), atol=1e-12)


@pytest.mark.parametrize("start", [25, 29, 36, 45, 53, 60])
def test_falling_bar_touches_again_where_the_characteristics_do(start):
    bar, (u, pressure) = falling_case(start, steps=20 * N)
    x, t, _, dt = grid(bar, len(u) - 1)
    again = float(bar.next_impact())
    is_free = (t[:-1, 0] > float(bar.contact_interval()[1]) + dt / 2) & (pressure > 0)
    # The projection acts in the first step that would end below the floor.
    step = np.argmax(is_free)
    assert dt * step - dt * 1e-6 <= again <= dt * (step + 1) + dt * 1e-6
    np.testing.assert_allclose(bar.displacement(0.0, again), -bar.gap, atol=ROUNDING)
    exact = np.asarray(bar.displacement(x, t))[: step + 1]
    np.testing.assert_allclose(exact, u[: step + 1], atol=ROUNDING)


def test_falling_bar_is_nan_after_the_next_impact_unless_periodic():
    bar = FallingBar(gap=5.1)
    assert not bar.is_periodic()
    t = np.array([-0.1, 1.0, bar.next_impact() - 1e-9, bar.next_impact() + 1e-9, 50.0])
    for values in (
        bar.displacement(3.0, t),
        bar.velocity(3.0, t),
        bar.strain(3.0, t),
        bar.mean_displacement(t),
        bar.contact_force(t),
        bar.accumulated_impulse(t),
        bar.kinetic_energy(t),
        bar.elastic_energy(t),
        bar.potential_energy(t),
    ):
        np.testing.assert_array_equal(np.isnan(values), [True, False, False, True, True])
    assert np.isnan(bar.period())


def test_falling_bar_is_nan_after_a_contact_without_separation():
    bar = FallingBar(gap=2.0)  # v0 = 6.3 < 2 g L/c = 6.7
    end = bar.contact_interval()[1]
    np.testing.assert_array_equal(bar.next_impact(), end)
    values = bar.displacement(0.0, jnp.array([end - 1e-6, end + 1e-6]))
    np.testing.assert_array_equal(np.isnan(values), [False, True])


def test_free_bar_gradients_are_those_of_the_formulas():
    bar = FreeBar(young=800.0, density=2.0, length=9.0, gap=4.0, impact_speed=7.0)
    # I = 2 rho L v0
    impulse = jax.grad(FreeBar.impulse)(bar)
    assert [float(impulse.impact_speed), float(impulse.density)] == [2 * 2 * 9, 2 * 9 * 7]
    assert [float(impulse.young), float(impulse.length)] == [0, 2 * 2 * 7]
    # The rebound velocity is v0.
    rebound = jax.grad(FreeBar.rebound_velocity)(bar)
    assert [float(rebound.impact_speed), float(rebound.young), float(rebound.density)] == [1, 0, 0]
    # start = h0/v0
    start = jax.grad(lambda b: b.contact_interval()[0])(bar)
    np.testing.assert_allclose([start.gap, start.impact_speed], [1 / 7, -4 / 49], rtol=1e-14)
    # end - start = 2 L sqrt(rho/E)
    lasting = jax.grad(lambda b: b.contact_interval()[1] - b.contact_interval()[0])(bar)
    np.testing.assert_allclose(lasting.young, -9 * np.sqrt(2) * 800**-1.5, rtol=1e-12)
    # p = v0 sqrt(E rho)
    force = jax.grad(lambda b: b.contact_force(0.7))(bar)
    np.testing.assert_allclose(
        [force.young, force.density, force.impact_speed],
        [3.5 * np.sqrt(2 / 800), 3.5 * 20, 40],
        rtol=1e-14,
    )
    # u = -h0 + v0 (t - h0/v0 - 2 L sqrt(rho/E)) after the rebound
    shift = jax.grad(lambda b: b.displacement(3.0, 5.0))(bar)
    np.testing.assert_allclose(
        [shift.gap, shift.impact_speed, shift.young],
        [-2, 5 - 18 / 20, 7 * 9 * np.sqrt(2) * 800**-1.5],
        rtol=1e-13,
    )


def test_falling_bar_gradients_are_those_of_the_formulas():
    bar = FallingBar(young=800.0, density=2.0, length=9.0, gap=6.0, gravity=9.0)
    v0, c = np.sqrt(2 * 9 * 6), 20.0
    # I = 2 rho L (v0 + g L/c), d(1/c)/dE = -1/(2 E c), d(1/c)/drho = 1/(2 rho c)
    impulse = jax.grad(FallingBar.impulse)(bar)
    expected = [36 * 9 / v0, -36 * 81 / (2 * 800 * c), 18 * (v0 + 81 / c) + 36 * 81 / (4 * c)]
    np.testing.assert_allclose([impulse.gap, impulse.young, impulse.density], expected, rtol=1e-13)
    # start = sqrt(2 h0/g)
    start = jax.grad(lambda b: b.contact_interval()[0])(bar)
    np.testing.assert_allclose([start.gap, start.gravity], [1 / v0, -v0 / 162], rtol=1e-13)
    # v0 = sqrt(2 g h0)
    rebound = jax.grad(FallingBar.rebound_velocity)(bar)
    np.testing.assert_allclose([rebound.gap, rebound.young], [9 / v0, 0], rtol=1e-13)


def test_clamped_bar_gradients_are_those_of_the_formulas():
    bar = ClampedBar(young=4.0, density=0.25, length=3.0, amplitude=0.7)  # c = 4, T0 = 3/4
    # I = a sqrt(E rho)
    impulse = jax.grad(ClampedBar.impulse)(bar)
    np.testing.assert_allclose([impulse.amplitude, impulse.young], [1, 0.7 / 8], rtol=1e-14)
    # u(0, t) = a (t/T0 - 2) in the first flight, d(1/T0)/dE = 1/(2 E T0)
    shift = jax.grad(lambda b: b.displacement(0.0, 1.8))(bar)
    np.testing.assert_allclose([shift.amplitude, shift.young], [0.4, 0.7 * 2.4 / 8], rtol=1e-13)


@pytest.mark.parametrize("name", ["displacement", "velocity", "strain"])
def test_falling_bar_fields_are_differentiable_between_the_fronts(name):
    t = jnp.array([0.5, 1.3, 1.6, 2.0, 2.2, 3.5])  # fall, both ways of the shock, flight

    @jax.jit
    def field(parameters):
        young, density, length, gap, gravity = parameters
        bar = FallingBar(young=young, density=density, length=length, gap=gap, gravity=gravity)
        return getattr(bar, name)(4.3, t)

    at = jnp.array([900.0, 1.0, 10.0, 5.2, 10.0])
    slopes = jax.jit(jax.jacrev(field))(at)
    steps = 1e-5 * jnp.diag(at)
    for slope, step in zip(slopes.T, steps, strict=True):
        difference = (field(at + step) - field(at - step)) / (2 * jnp.sum(step))
        # Central differences: truncation 1e-9 and rounding 1e-16/1e-5, both relative.
        np.testing.assert_allclose(slope, difference, rtol=1e-7, atol=1e-8)


def test_falling_bar_gradient_is_nan_where_periodicity_would_break():
    bar = FallingBar()
    before = jax.grad(lambda b: b.displacement(4.0, 3.0))(bar)
    after = jax.grad(lambda b: b.displacement(4.0, 4.0))(bar)
    assert np.isfinite(jax.tree.leaves(before)).all()
    assert np.isnan(jax.tree.leaves(after)).all()
    # In time and space it stays differentiable.
    rate = jax.grad(bar.displacement, argnums=1)(4.0, 4.3)
    np.testing.assert_allclose(rate, bar.velocity(4.0, 4.3), rtol=1e-12)


def test_bar_functions_vectorise_under_jit_and_vmap():
    speeds = jnp.array([5.0, 10.0])
    x, t = jnp.linspace(0, 10, 4)[:, None], jnp.linspace(0, 2, 5)[None]
    fields = jax.jit(jax.vmap(lambda v: FreeBar(impact_speed=v).displacement(x, t)))(speeds)
    assert fields.shape == (2, 4, 5)
    np.testing.assert_allclose(fields[1], FreeBar().displacement(x, t), rtol=1e-14)


# Half-disc numbers of the right size: R [m], E [Pa], P [N/m].
HERTZ = Hertz(young=1e8, poisson=0.3, radius=15.0, load=3.8e6)


def test_hertz_pressure_integrates_to_the_load():
    angle = np.pi * np.arange(1, 200) / 200  # x = a cos(angle), the periodic rule
    a = float(HERTZ.half_width())
    load = np.sum(np.asarray(HERTZ.pressure(a * np.cos(angle))) * a * np.sin(angle)) * np.pi / 200
    np.testing.assert_allclose(load, 3.8e6, rtol=1e-13)
    np.testing.assert_allclose(HERTZ.mean_pressure() * 2 * a, load, rtol=1e-13)


def test_hertz_pressure_flattens_the_cylinder():
    # Half plane: u'(x) = -2 (1 - nu^2)/(pi E) PV int p(s)/(x - s) ds = -x/R in the contact zone,
    # with the quadrature of Erdogan and Gupta, exact at these points.
    n, a = 40, float(HERTZ.half_width())
    s = a * np.cos(np.pi * np.arange(1, n + 1) / (n + 1))
    x = a * np.cos(np.pi * (2 * np.arange(1, n + 2) - 1) / (2 * (n + 1)))
    weights = np.pi / (n + 1) * np.sqrt(a**2 - s**2) * np.asarray(HERTZ.pressure(s))
    slope = -2 * 0.91 / (np.pi * 1e8) * (1 / (x[:, None] - s) @ weights)
    np.testing.assert_allclose(slope, -x / 15, atol=1e-13)


def test_hertz_pressure_vanishes_outside_with_a_finite_derivative():
    a = HERTZ.half_width()
    x = a * jnp.array([-2.0, -1.0, 1.0, 3.0])
    np.testing.assert_array_equal(HERTZ.pressure(x), 0)
    np.testing.assert_array_equal(jax.vmap(jax.grad(HERTZ.pressure))(x), 0)
    np.testing.assert_allclose(HERTZ.pressure(0.0), HERTZ.peak_pressure(), rtol=1e-15)


def test_hertz_from_half_width_returns_the_load():
    again = Hertz.from_half_width(HERTZ.half_width(), young=1e8, poisson=0.3, radius=15.0)
    np.testing.assert_allclose(again.load, 3.8e6, rtol=1e-14)


def test_hertz_peak_pressure_grows_with_the_root_of_the_load():
    slope = jax.grad(Hertz.peak_pressure)(HERTZ)  # p0 = sqrt(P E/(pi R (1 - nu^2)))
    p0 = float(HERTZ.peak_pressure())
    np.testing.assert_allclose(slope.load, p0 / (2 * 3.8e6), rtol=1e-13)
    np.testing.assert_allclose(slope.radius, -p0 / (2 * 15), rtol=1e-13)


def contact_implicit_losses(theta, courant, n, lumped, steps):
    """Energy lost by a bar that flies with speed 1, relative to the start, after every step."""
    h, dt = 1 / n, courant / n
    stencil = np.diag(np.ones(n + 1)), np.diag(np.ones(n), 1) + np.diag(np.ones(n), -1)
    ends = np.r_[0.5, np.ones(n - 1), 0.5]
    mass = np.diag(ends * h) if lumped else h * (np.diag(ends) * 4 + stencil[1]) / 6
    stiffness = (2 * np.diag(ends) - stencil[1]) / h
    D = np.linalg.inv(mass + dt**2 / 4 * stiffness)
    y, v = np.zeros(n + 1), -np.ones(n + 1)
    losses = []
    for _ in range(steps):
        w = D @ (mass @ v - dt / 2 * stiffness @ y)
        short = max(-theta * dt - (y + dt * w)[0], 0)
        w = w + D[:, 0] / D[0, 0] * short / dt
        y, v = y + dt * w, 2 * w - v
        losses.append(1 - v @ mass @ v - y @ stiffness @ y)
    return np.array(losses)


@pytest.mark.parametrize("lumped", [False, True])
@pytest.mark.parametrize(("theta", "courant"), [(0.5, 1.0), (0.2, 1.0), (0.7, 0.5), (0.9, 2.0)])
def test_first_touch_loss_is_that_of_a_simulated_step(theta, courant, lumped):
    simulated = contact_implicit_losses(theta, courant, 60, lumped, 1)[0]
    loss = first_touch_loss(theta, courant, 60, lumped=lumped)
    np.testing.assert_allclose(loss, simulated, rtol=1e-10)


def test_first_touch_loss_is_that_of_the_whole_impact_at_half_a_step():
    losses = contact_implicit_losses(0.5, 1.0, 60, False, 180)
    np.testing.assert_allclose(losses, first_touch_loss(0.5, 1.0, 60), rtol=1e-10)


def test_first_touch_loss_of_200_cells_has_the_measured_value():
    np.testing.assert_allclose(first_touch_loss(0.5, 1.0, 200), 2.8867513459e-3, rtol=1e-10)


# One compilation instead of one per operation: they run for many masses.
position, velocity = jax.jit(BouncingMass.position), jax.jit(BouncingMass.velocity)
impact_time = jax.jit(BouncingMass.impact_time)


#: Two programs may round the time of an impact differently, by a few units of the last place.
INSTANT = 1e-15


def bounce(mass, time):
    """Position and velocity at a time by following the impacts one by one, and their times."""
    height, velocity, now, impacts = mass.height, mass.initial_velocity, 0.0, []
    while len(impacts) < 200:
        speed = np.sqrt(velocity**2 + 2 * mass.gravity * height)
        flight = (velocity + speed) / mass.gravity
        if now + flight > time:
            elapsed = time - now
            position = height + velocity * elapsed - mass.gravity * elapsed**2 / 2
            return position, velocity - mass.gravity * elapsed, impacts
        now, height, velocity = now + flight, 0.0, mass.restitution * speed
        impacts.append(now)
    return 0.0, 0.0, impacts


MASSES = {
    "elastic": BouncingMass(),
    "nearly elastic": BouncingMass(restitution=0.999999, initial_velocity=2.0, mass=3.0),
    "inelastic": BouncingMass(restitution=0.7, height=1.0, initial_velocity=-3.0, mass=2.0),
    "plastic": BouncingMass(restitution=0.0, gravity=9.81),
}


@pytest.mark.parametrize("mass", MASSES.values(), ids=MASSES)
def test_bouncing_mass_follows_the_impacts_one_by_one(mass):
    t = np.linspace(0, 6.9, 101)
    expected = np.array([bounce(mass, time)[:2] for time in t])
    # Near the accumulation of impacts the loop adds up two hundred rounded flights.
    np.testing.assert_allclose(position(mass, t), expected[:, 0], atol=1e-11)
    np.testing.assert_allclose(velocity(mass, t), expected[:, 1], atol=1e-11)


@pytest.mark.parametrize("mass", MASSES.values(), ids=MASSES)
def test_bouncing_mass_impact_times_are_those_of_the_loop(mass):
    _, _, impacts = bounce(mass, 30.0)
    impacts = np.array(impacts[:20])
    times = impact_time(mass, np.arange(len(impacts)))
    np.testing.assert_allclose(times, impacts, rtol=1e-13)
    after = times * (1 + INSTANT)
    np.testing.assert_allclose(
        velocity(mass, after), mass.impact_speed(np.arange(len(impacts)) + 1), atol=1e-11
    )


@pytest.mark.parametrize("name", ["elastic", "nearly elastic", "inelastic"])
def test_bouncing_mass_velocity_just_before_an_impact_is_the_incoming_one(name):
    k = np.arange(20)
    before = impact_time(MASSES[name], k) * (1 - INSTANT)
    expected = -MASSES[name].impact_speed(k)
    np.testing.assert_allclose(velocity(MASSES[name], before), expected, atol=1e-11)


def test_bouncing_mass_loses_the_square_of_the_restitution_per_impact():
    mass = MASSES["inelastic"]
    times = mass.impact_time(np.arange(6))
    energy = np.asarray(mass.energy(times + 1e-3))
    np.testing.assert_allclose(energy, 2 * (4.5 + 10) * 0.49 ** np.arange(1, 7), rtol=1e-10)


def test_bouncing_mass_rests_after_the_last_impact():
    mass = MASSES["inelastic"]
    end = mass.rest_time()
    np.testing.assert_allclose(end, mass.impact_time(200), rtol=1e-12)
    np.testing.assert_array_equal(position(mass, end + jnp.arange(3)), 0)
    np.testing.assert_allclose(mass.contact_force_mean(end, end + 1), 2 * 10, rtol=1e-12)
    assert np.isinf(BouncingMass().rest_time())
    assert np.isnan(position(mass, -0.1))


def test_bouncing_mass_force_means_add_up_to_the_impulses():
    mass = MASSES["inelastic"]
    t = np.linspace(0, mass.impact_time(3) + 0.01, 30)
    total = jnp.sum(mass.contact_force_mean(t[:-1], t[1:]) * np.diff(t))
    np.testing.assert_allclose(total, jnp.sum(mass.impulse(np.arange(4))), rtol=1e-12)


@pytest.mark.parametrize("e", [1.0, 0.9999, 0.98, 0.6])
def test_bouncing_mass_impact_time_has_the_derivative_of_the_geometric_sum(e):
    mass, k = BouncingMass(restitution=e), 7
    slope = jax.grad(lambda m: m.impact_time(k))(mass)
    # t_k = sqrt(2 h/g) (1 + 2 sum_j e^j), so d/de = 2 sqrt(2 h/g) sum_j j e^(j-1)
    j = np.arange(1, k + 1)
    np.testing.assert_allclose(slope.restitution, 2 * np.sum(j * e ** (j - 1)), rtol=1e-9)
    np.testing.assert_allclose(slope.height, 0.1 * (1 + 2 * np.sum(e**j)), rtol=1e-12)


@pytest.mark.parametrize("e", [1.0, 0.7, 0.0])
def test_bouncing_mass_position_has_the_derivative_of_its_flight(e):
    # After the first impact: y = e w s - g s^2/2, s = t - w/g, w = sqrt(2 g h)
    slope = jax.grad(lambda m: m.position(1.4))(BouncingMass(restitution=e))
    speed = e * 10 - 10 * 0.4 if e > 0 else 0.0
    np.testing.assert_allclose(slope.restitution, 10 * 0.4 if e > 0 else 0.0, atol=1e-12)
    np.testing.assert_allclose(slope.height, e * 0.4 - speed / 10, atol=1e-12)
