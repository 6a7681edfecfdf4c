import subprocess
import sys

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.output import plot
from jaxcontact.scene.cells import cell_volumes

mpl.use("Agg")

from matplotlib import pyplot

#: The motions chatter, and `test_chatter.py` says what is said then.
pytestmark = pytest.mark.filterwarnings("ignore::jaxcontact.ChatterWarning")

STEPS, DT = 12, 5e-5


@pytest.fixture(scope="module")
def problem():
    return jc.scenes.half_disc_control(h=3.75, steps=STEPS, dt=DT, gap=0.01)


@pytest.fixture(scope="module")
def trajectory(problem):
    """Touches the plane within the twelve steps."""
    return problem.simulate(problem.reference)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


def curves(ax):
    return {line.get_label(): line.get_ydata() for line in ax.lines}


def tick_label(axis, value):
    return axis.get_major_formatter()(value, None)


def test_plot_mesh_names_every_facet_set(problem):
    mesh = problem.scene.mesh
    ax = plot.plot_mesh(mesh)
    assert {text.get_text() for text in ax.get_legend().get_texts()} == set(mesh.facets)
    ends = curves(ax)["contact"]
    assert np.nanmin(ends) == pytest.approx(-15.0, rel=1e-14)
    assert np.count_nonzero(np.isnan(ends)) == len(mesh.facets["contact"])


def test_plot_mesh_moves_with_the_displacement(problem):
    mesh = problem.scene.mesh
    at_rest, moved = plot.plot_mesh(mesh), plot.plot_mesh(mesh, np.full(mesh.points.shape, 2.0))
    np.testing.assert_allclose(
        curves(moved)["contact"], curves(at_rest)["contact"] + 2.0, rtol=1e-14
    )


def test_plot_control_colours_nodes_by_magnitude(problem):
    ax = plot.plot_control(problem.scene.mesh, 3.0 * problem.reference[0])
    np.testing.assert_allclose(ax.collections[0].get_array(), 3.0, rtol=1e-15)


def test_plot_control_refuses_a_control_of_all_times(problem):
    with pytest.raises(ValueError, match="choose one time"):
        plot.plot_control(problem.scene.mesh, problem.reference)


def test_plot_mesh_of_a_solid_refers_to_paraview():
    with pytest.raises(ValueError, match="ParaView"):
        plot.plot_mesh(jc.meshes.box((1.0, 1.0, 1.0), h=1.0))


def test_plot_history_draws_the_excess_over_the_least_value():
    ax = plot.plot_history([5.0, 3.0, 1.0, 2.0])
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), [4.0, 2.0, np.nan, 1.0])
    assert ax.get_yscale() == "log"


def test_plot_distance_draws_what_it_is_given():
    np.testing.assert_array_equal(plot.plot_distance([1.0, 0.5]).lines[0].get_ydata(), [1.0, 0.5])


def test_plot_state_error_is_the_l2_norm_of_the_body(problem, trajectory):
    # A constant difference (3, 4) has the norm 5 sqrt(|Omega|).
    target = trajectory.displacement - jnp.array([3.0, 4.0])[None, None, :]
    ax = plot.plot_state_error(problem.system, trajectory, target)
    mesh = problem.scene.mesh
    area = np.sum(cell_volumes(np.asarray(mesh.points), mesh.cells))
    np.testing.assert_allclose(ax.lines[0].get_ydata(), 5.0 * np.sqrt(area), rtol=1e-12)
    assert ax.get_ylabel().endswith("[m$^{2}$]")


def test_plot_contact_force_sums_to_impulse_over_time(problem, trajectory):
    step = 1 + int(np.argmax(np.sum(trajectory.contact_impulse, axis=1)))
    total = np.sum(trajectory.contact_impulse[step - 1]) / DT
    line = plot.plot_contact_force(problem.system, trajectory, step).lines[0]
    assert total > 0.0
    assert np.sum(line.get_ydata()) == pytest.approx(float(total), rel=1e-12)
    assert np.all(np.diff(line.get_xdata()) > 0.0)


def test_plot_contact_force_refuses_step_zero(problem, trajectory):
    with pytest.raises(ValueError, match=r"one of 1, \.\.\., 12, got 0"):
        plot.plot_contact_force(problem.system, trajectory, 0)


def test_plot_active_set_shows_exactly_the_closed_pairs(problem, trajectory):
    ax = plot.plot_active_set(problem.system, trajectory)
    image = ax.collections[0].get_array()
    order = np.argsort(np.asarray(problem.system.points)[problem.system.contact_nodes, 0])
    assert np.any(trajectory.active)
    np.testing.assert_array_equal(~np.ma.getmaskarray(image), trajectory.active[:, order].T)


def test_plot_energy_curves_satisfy_the_ledger(problem, trajectory):
    ledger = jc.energy(problem.stepper, trajectory, problem.control_scale * problem.reference)
    drawn = curves(plot.plot_energy(trajectory, ledger))
    balance = drawn["work until then"] - drawn["viscous loss until then"]
    np.testing.assert_allclose(
        drawn["total"],
        balance - drawn["impact loss until then"],
        rtol=0.0,
        atol=1e-12 * np.max(drawn["total"]),
    )
    np.testing.assert_allclose(drawn["total"], drawn["kinetic"] + drawn["elastic"], rtol=1e-14)


def test_ticks_carry_the_prefix_that_the_label_names(problem, trajectory):
    ax = plot.plot_state_error(problem.system, trajectory, trajectory.displacement)
    # Six tenths of a millisecond are 600 microseconds.
    assert ax.get_xlabel() == "time [µs]"
    assert tick_label(ax.xaxis, 6e-4) == "600"


def test_plots_share_given_axes_and_open_no_figure(problem, trajectory):
    ax = pyplot.figure().add_subplot()
    first = plot.plot_contact_force(problem.system, trajectory, 1, label="one")
    assert first is not ax
    assert plot.plot_contact_force(problem.system, trajectory, 1, label="one", ax=ax) is ax
    n_figures = len(pyplot.get_fignums())
    plot.plot_contact_force(problem.system, trajectory, 2, label="two", ax=ax)
    assert set(curves(ax)) == {"one", "two"}
    assert len(pyplot.get_fignums()) == n_figures


def test_plot_without_matplotlib_says_how_to_install_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"pip install 'jaxcontact\[plot\]'"):
        plot.plot_history([1.0, 0.5])


def test_import_of_the_package_leaves_matplotlib_and_the_configuration_alone():
    program = (
        "import sys, jax; before = dict(jax.config.values); import jaxcontact; "
        "import jaxcontact.output.plot, jaxcontact.output.export; "
        "assert dict(jax.config.values) == before; "
        "assert not {'matplotlib', 'tqdm'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_pictures_of_contact_need_no_states_but_those_that_are_recorded(problem, trajectory):
    force = problem.control_scale * problem.reference
    coarse = jc.simulate(problem.stepper, force, save_every=3)
    for draw in (
        lambda motion: plot.plot_active_set(problem.system, motion).collections[0].get_array(),
        lambda motion: plot.plot_contact_force(problem.system, motion, STEPS).lines[0].get_ydata(),
    ):
        np.testing.assert_allclose(draw(coarse), draw(trajectory), rtol=1e-12)
