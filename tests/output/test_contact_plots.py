"""Pictures of contact over time and over the contact surface show the numbers of the motion."""

import matplotlib as mpl
import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.output.axes import moment_of
from jaxcontact.output.contact_plots import _surface

mpl.use("Agg")

from matplotlib import pyplot

MATERIAL = jc.KelvinVoigt(young=100.0, poisson=0.3)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    pyplot.close("all")


@pytest.fixture(scope="module")
def disc():
    """Its contact nodes are not in the order of their numbers along the arc."""
    mesh = jc.meshes.disc(1.0, h=0.5, contact=(150.0, 270.0))
    floor = jc.HalfSpace(point=[0.0, -1.05], normal=[0.0, 1.0])
    system = jc.discretize(jc.Scene(mesh, MATERIAL, contact={"contact": floor}))
    stepper = jc.prepare(system, 0.02, scheme=jc.ContactStabilized())
    thrown = jc.State(velocity=np.tile([0.0, -1.0], (mesh.n_nodes, 1)))
    return mesh, stepper, jc.simulate(stepper, steps=12, initial=thrown)


@pytest.fixture(scope="module")
def cube():
    mesh = jc.meshes.box((1.0, 2.0, 1.0), h=1.0)
    floor = jc.HalfSpace(point=[0.0, 0.0, -0.02], normal=[0.0, 0.0, 1.0])
    system = jc.discretize(jc.Scene(mesh, MATERIAL, contact={"bottom": floor}))
    stepper = jc.prepare(system, 0.02, scheme=jc.ContactStabilized())
    thrown = jc.State(velocity=np.tile([0.0, 0.0, -1.0], (mesh.n_nodes, 1)))
    return mesh, stepper, jc.simulate(stepper, steps=6, initial=thrown)


def test_plot_force_shows_the_total_in_the_middle_of_each_step(disc):
    motion = disc[2]
    (line,) = jc.plot.plot_force(motion, label="bounce").lines
    total = np.asarray(motion.contact_force).sum(axis=1)
    assert total.max() > 0.0
    np.testing.assert_allclose(line.get_ydata(), total)
    np.testing.assert_allclose(line.get_xdata(), 0.02 * (np.arange(12) + 0.5))
    assert "per metre of thickness [N]" in line.axes.get_ylabel()


def test_contact_nodes_of_the_plane_stand_in_order_along_the_boundary(disc):
    mesh, stepper, _ = disc
    nodes = _surface(stepper.system).nodes
    edges = {tuple(edge) for edge in mesh.facets["contact"].tolist()}
    assert all(edge in edges for edge in zip(nodes[:-1].tolist(), nodes[1:].tolist(), strict=True))
    assert len(nodes) == len(edges) + 1


@pytest.mark.parametrize("quantity", ["pressure", "gap"])
def test_image_over_time_and_arc_length_has_the_values_of_every_pair(disc, quantity):
    mesh, stepper, motion = disc
    if quantity == "pressure":
        ax, values = jc.plot.plot_pressure(stepper, motion), jc.contact_pressure(stepper, motion)
    else:
        ax, values = jc.plot.plot_gap(stepper.system, motion), motion.gap[1:]
    nodes = _surface(stepper.system).nodes
    order = [int(np.flatnonzero(stepper.system.contact_nodes == node)[0]) for node in nodes]
    image = np.asarray(ax.collections[0].get_array()).reshape(len(nodes), 12)
    np.testing.assert_allclose(image, np.asarray(values)[:, order].T)
    low, high = ax.get_ylim()
    lengths = np.linalg.norm(np.diff(mesh.points[nodes], axis=0), axis=1)
    assert high - low == pytest.approx(lengths.sum() + 0.5 * (lengths[0] + lengths[-1]))


def test_one_step_is_a_curve_over_the_arc_length(disc):
    _, stepper, motion = disc
    (line,) = jc.plot.plot_pressure(stepper, motion, step=5).lines
    pressure = np.asarray(jc.contact_pressure(stepper, motion))[4]
    np.testing.assert_allclose(np.sort(line.get_ydata()), np.sort(pressure))
    assert line.axes.get_title() == "t = 100 ms"


def test_map_of_a_face_in_space_shows_the_step_of_the_largest_force(cube):
    mesh, stepper, motion = cube
    ax = jc.plot.plot_pressure(stepper, motion)
    step = int(np.asarray(motion.contact_force).sum(axis=1).argmax())
    shown = np.sort(np.asarray(ax.collections[0].get_array()))
    expected = np.sort(np.asarray(jc.contact_pressure(stepper, motion))[step])
    np.testing.assert_allclose(shown, expected)
    assert ax.get_title() == moment_of(0.02 * (step + 1), motion.time)
    # The face of one by two metres is not turned.
    extent = np.ptp(ax.collections[0].get_datalim(ax.transData).get_points(), axis=0)
    np.testing.assert_allclose(np.sort(extent), [1.0, 2.0])
    assert mesh.dimension == 3


def test_picture_of_a_step_that_is_not_there_is_refused(disc):
    _, stepper, motion = disc
    with pytest.raises(ValueError, match=r"step must be one of 1, \.\.\., 12, got 13"):
        jc.plot.plot_gap(stepper.system, motion, step=13)


def test_gap_of_some_of_the_states_is_refused(disc):
    _, stepper, _ = disc
    coarse = jc.simulate(stepper, steps=4, save_every=2)
    with pytest.raises(ValueError, match="save_every=1"):
        jc.plot.plot_gap(stepper.system, coarse)
