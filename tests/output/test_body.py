"""Pictures and animations of bodies: they show what they are given, where it is."""

import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import PolyCollection, TriMesh
from PIL import Image

import jaxcontact as jc

DISC = jc.scenes.half_disc(h=5.0)
BALL = jc.Scene(
    jc.meshes.half_ball(1.0, h=0.6),
    jc.KelvinVoigt(young=1.0, poisson=0.3),
    contact={"contact": jc.HalfSpace(np.array([0.0, 0.0, -1.1]), np.array([0.0, 0.0, 1.0]))},
)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def positions(collection):
    return np.concatenate([path.vertices for path in collection.get_paths()])


def test_plot_body_draws_moved_nodes_and_values():
    y = np.zeros(DISC.mesh.points.shape)
    y[:, 1] = -0.5
    values = np.arange(DISC.mesh.n_nodes, dtype=float)
    ax = jc.plot.plot_body(DISC, y, values, scale=2.0, label="number []")
    drawn = next(x for x in ax.collections if isinstance(x, TriMesh))
    np.testing.assert_array_equal(drawn.get_array(), values)
    lines = next(x for x in ax.collections if type(x).__name__ == "LineCollection")
    assert positions(lines)[:, 1].max() == pytest.approx(DISC.mesh.points[:, 1].max() - 1.0)
    assert ax.get_aspect() == 1.0
    bar = ax.figure.axes[1]
    assert bar.get_ylabel() == "number []"


def test_plot_body_colours_cells_and_the_lengths_of_vectors():
    cells = np.arange(DISC.mesh.n_cells, dtype=float)
    drawn = jc.plot.plot_body(DISC, values=cells).collections
    faces = next(x for x in drawn if isinstance(x, PolyCollection) and len(x.get_paths()) > 1)
    np.testing.assert_array_equal(faces.get_array(), cells)
    vectors = np.full(DISC.mesh.points.shape, [3.0, 4.0])
    drawn = jc.plot.plot_body(DISC, values=vectors).collections
    np.testing.assert_allclose(next(x for x in drawn if isinstance(x, TriMesh)).get_array(), 5.0)


def test_plot_body_names_every_obstacle_that_is_seen():
    low, high = [-16.0, -18.0], [16.0, 1.0]
    assert not jc.plot.plot_body(DISC, limits=([-16.0, -15.5], high)).texts
    (name,) = jc.plot.plot_body(DISC, limits=(low, high)).texts
    assert name.get_text() == "contact"
    # The plane is at -15.8, and the body is not on it.
    assert -18.0 < name.xy[1] < -15.8


def test_plot_body_of_two_bodies_draws_both():
    scene = jc.scenes.two_discs(h=0.5)
    ax = jc.plot.plot_body(scene)
    lines = next(x for x in ax.collections if type(x).__name__ == "LineCollection")
    assert positions(lines)[:, 1].max() == pytest.approx(scene.mesh.points[:, 1].max())
    assert positions(lines)[:, 1].min() == pytest.approx(scene.mesh.points[:, 1].min())


@pytest.mark.parametrize("place", ["nodes", "cells"])
def test_plot_body_in_space_draws_the_skin_with_its_values(place):
    mesh = BALL.mesh
    count = {"nodes": mesh.n_nodes, "cells": mesh.n_cells}[place]
    height = mesh.points[:, 2] if place == "nodes" else mesh.points[mesh.cells, 2].mean(axis=1)
    ax = jc.plot.plot_body(BALL, values=height, label="height [m]")
    (skin,) = ax.collections
    faces = jc.scene.mesh.boundary_facets(mesh.cells)
    assert count == len(height)
    assert len(skin.get_facecolor()) == len(faces)
    assert np.ptp(skin.get_facecolor()[:, :3], axis=0).min() > 0.1


def test_values_of_cells_lie_on_their_own_facets_in_space():
    mesh = jc.meshes.box((1.0, 1.0, 1.5), h=0.5)
    scene = jc.Scene(mesh, BALL.material)
    is_low = mesh.points[mesh.cells, 2].mean(axis=1) < 0.5
    ax = jc.plot.plot_body(scene, values=is_low.astype(float))
    faces = jc.scene.mesh.boundary_facets(mesh.cells)
    # Matplotlib sorts the facets by their depth.
    colors = ax.collections[0].get_facecolor()
    is_yellow = colors[:, 0] > colors[:, 2]
    assert np.sum(is_yellow) == np.sum(mesh.points[faces, 2].mean(axis=1) < 0.5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((3, 2)),), "displacement must have shape"),
        ((None, np.zeros(3)), "values have shape"),
    ],
)
def test_plot_body_refuses_what_does_not_fit(arguments, message):
    with pytest.raises(ValueError, match=message):
        jc.plot.plot_body(DISC, *arguments)


def test_plot_body_of_a_bar_says_what_to_plot():
    with pytest.raises(ValueError, match=r"against mesh\.points"):
        jc.plot.plot_body(jc.scenes.bars(h=0.5))


@pytest.fixture(scope="module")
def fall():
    system = jc.discretize(DISC)
    stepper = jc.prepare(system, 1e-3)
    velocity = jnp.zeros(DISC.mesh.points.shape)
    free = jnp.asarray(system.free_nodes)
    initial = jc.State(velocity, velocity.at[free, 1].set(-50.0))
    return jc.simulate(stepper, steps=8, initial=initial)


def test_animate_writes_a_frame_for_every_state_up_to_their_number(fall, tmp_path):
    path = tmp_path / "fall.gif"
    jc.plot.animate(DISC, fall, path, values=fall.velocity, label="speed [m/s]", frames=4)
    with Image.open(path) as picture:
        assert picture.n_frames == 4
    jc.plot.animate(DISC, fall, path, frames=100, seconds=0.9)
    with Image.open(path) as picture:
        assert picture.n_frames == 9
        assert picture.info["duration"] == pytest.approx(100, abs=10)


def test_animate_refuses_other_files_before_it_draws(fall, tmp_path):
    with pytest.raises(ValueError, match=r"\.gif or \.mp4"):
        jc.plot.animate(DISC, fall, tmp_path / "fall.avi")
    assert not plt.get_fignums()
