"""Claims about recommendations: they hold what they promise, or say that they do not."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from support.falling_bar import BAR, build, exact_mean, mean_height

import jaxcontact as jc

TOLERANCE = 0.03
SCHEMES = (jc.ContactStabilized(),)


def known(stepper):
    """1 + h / 50 + dt: a quantity of known errors, without a simulation"""
    h = stepper.system.points[1, 0] - stepper.system.points[0, 0]
    return 1.0 + h / 50.0 + stepper.dt


def test_recommendation_refines_what_is_worth_it_until_it_is_enough():
    advice = jc.recommend(build, known, TOLERANCE, schemes=SCHEMES, h=5.0, dt=0.01)
    assert advice.is_reached
    # Of first order errors the estimate, of order between one and two, has three quarters.
    assert advice.h / 50.0 + advice.dt <= 4.0 / 3.0 * TOLERANCE
    # The time step is no larger an error than the mesh: it is left alone.
    assert advice.dt == 0.01
    assert advice.h == 1.25
    last = advice.evidence[-1].error
    np.testing.assert_allclose(last.space, 1.5 * advice.h / 100.0)
    assert [x.choice.h for x in advice.evidence] == [2.5, 1.25]


def test_the_coarsest_mesh_is_never_enough():
    advice = jc.recommend(build, known, 0.2, schemes=SCHEMES, h=2.5, dt=0.01)
    assert advice.h == 1.25


def test_a_small_difference_of_two_meshes_is_not_believed_after_a_large_one():
    def by_chance(stepper):
        return 1.0 + 0.5 * (stepper.system.n_nodes == 1 + round(BAR.length / 2.5))

    advice = jc.recommend(build, by_chance, TOLERANCE, schemes=SCHEMES, h=2.5, dt=0.01)
    assert advice.h == 0.625


@pytest.fixture(scope="module")
def advice():
    return jc.recommend(build, mean_height, TOLERANCE, schemes=SCHEMES, h=2.5, dt=0.04)


@pytest.mark.slow
def test_recommendation_is_within_the_tolerance(advice):
    assert advice.is_reached
    scene = build(advice.h)
    stepper = jc.prepare(jc.discretize(scene), advice.dt, scheme=advice.scheme)
    error = abs(mean_height(stepper)[0] - exact_mean())
    assert error < TOLERANCE * abs(exact_mean())
    assert advice.seconds > 0.0


def test_recommendation_shows_what_it_is_founded_on():
    advice = jc.recommend(build, known, TOLERANCE, schemes=SCHEMES, h=2.5, dt=0.01)
    table = str(advice)
    assert "within the tolerance" in table
    assert len(table.splitlines()) == 2 + len(advice.evidence)
    axes = advice.plot()
    assert axes.get_xlabel() == "unknowns"
    plt.close(axes.figure)


@pytest.mark.slow
def test_recommendation_warns_of_large_strains(advice):
    """The bar is pressed together by more than a tenth"""
    assert any("strain or rotation reaches" in sentence for sentence in advice.warnings)


def test_recommendation_says_when_the_tolerance_is_not_reached():
    advice = jc.recommend(build, known, 1e-4, schemes=SCHEMES, budget=0.0, h=2.5, dt=0.01)
    assert not advice.is_reached
    assert "tolerance not reached" in str(advice)
    assert advice.error > 0.0
    assert advice.warnings == ()


@pytest.mark.parametrize(
    ("tolerance", "options", "message"),
    [
        (0.0, {}, "between 0 and 1"),
        (0.1, {"schemes": ()}, "at least one scheme"),
        (0.1, {"schemes": ("implicit",)}, "schemes"),
    ],
)
def test_recommend_says_what_is_wrong(tolerance, options, message):
    with pytest.raises(ValueError, match=message):
        jc.recommend(build, mean_height, tolerance, **options)
