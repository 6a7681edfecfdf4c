import numpy as np
import pytest

import jaxcontact as jc

BALL = jc.meshes.half_ball(1.0, h=0.5)
BOWL = jc.Ball(center=[0.0, 0.0, 1.0], radius=2.2, inside=True)
SCENE = jc.Scene(BALL, jc.KelvinVoigt(young=1.0, poisson=0.3), contact={"contact": BOWL})


def test_space_body_has_the_cells_the_field_and_the_obstacle(tmp_path):
    pytest.importorskip("pyvista")
    values = np.arange(float(BALL.n_nodes))
    path = tmp_path / "ball.png"
    plotter = jc.plot.space_body(SCENE, 0.0 * BALL.points, values, label="number", path=path)
    body, bowl = plotter.meshes
    assert body.n_cells == BALL.n_cells
    np.testing.assert_array_equal(body.active_scalars, values)
    distance = np.linalg.norm(bowl.points - [0.0, 0.0, 1.0], axis=1)
    np.testing.assert_allclose(distance, 2.2, atol=0.01)
    assert path.read_bytes()[1:4] == b"PNG"
    plotter.close()


def test_space_body_of_a_planar_scene_names_the_other_picture():
    flat = jc.Scene(jc.meshes.rectangle((1.0, 1.0), h=0.5), SCENE.material)
    with pytest.raises(ValueError, match="use plot_body"):
        jc.plot.space_body(flat)
