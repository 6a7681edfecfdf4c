"""The examples of CONTRIBUTING.md run as they stand, and do what they are said to do."""

import re
from pathlib import Path

import numpy as np
import pytest

import jaxcontact as jc
from jaxcontact.linear.dense import DenseFactor
from jaxcontact.linear.dissection.nested_dissection import DissectionFactor

CONTRIBUTING = Path(__file__).parents[2] / "CONTRIBUTING.md"


@pytest.fixture(scope="module")
def example():
    """The names that the Python blocks define, run one after the other."""
    text = CONTRIBUTING.read_text(encoding="utf-8")
    names: dict = {"__name__": "example"}
    for number, block in enumerate(re.findall(r"^```python\n(.*?)^```$", text, re.M | re.S)):
        exec(compile(block, f"{CONTRIBUTING.name}, block {number}", "exec"), names)
    return names


def test_contributed_obstacle_turns_the_block_back(example):
    # The gap is 0.105 m, free flight would end at 0.6 m, and an elastic rebound with the speed of
    # impact at -0.39 m; contact holds the block for a time.
    assert -0.39 < example["position"] < 0.105


def test_contributed_obstacle_has_the_gradient_of_the_difference_quotient(example):
    final_position, step = example["final_position"], 1e-6
    difference = final_position(2.21 + step) - final_position(2.21 - step)
    assert example["by_width"] != 0.0
    np.testing.assert_allclose(example["by_width"], difference / (2 * step), rtol=1e-6)


def test_contributed_linear_solver_gives_the_same_motion_by_either_factor(example):
    np.testing.assert_allclose(example["by_dense"], example["position"], rtol=1e-10)
    np.testing.assert_allclose(example["by_dissection"], example["position"], rtol=1e-10)


def test_contributed_contact_solver_gives_the_same_motion(example):
    np.testing.assert_allclose(example["by_gradient_steps"], example["position"], rtol=1e-9)


@pytest.mark.parametrize(("limit", "expected"), [(500, DenseFactor), (10, DissectionFactor)])
def test_contributed_linear_solver_hands_over_by_the_number_of_unknowns(example, limit, expected):
    body = jc.meshes.rectangle((1.0, 1.0), h=0.5)
    system = jc.discretize(jc.Scene(body, jc.KelvinVoigt(young=100.0, poisson=0.3)))
    factor = example["DenseUpTo"](limit).factorize(system.mass.expand(), system.normals)
    assert isinstance(factor, expected)


@pytest.fixture(scope="module")
def bounce():
    """The step length and the motion of a thrown block by any scheme."""
    body = jc.meshes.rectangle((1.0, 1.0), h=0.5)
    scene = jc.Scene(
        body,
        jc.KelvinVoigt(young=100.0, poisson=0.3, shear_viscosity=0.1),
        contact={"bottom": jc.HalfSpace([0.0, -0.1], [0.0, 1.0])},
    )
    system = jc.discretize(scene)
    still = np.zeros(body.points.shape)
    thrown = jc.State(displacement=still, velocity=still - np.array([0.0, 1.0]))

    def run(scheme):
        stepper = jc.prepare(system, 0.02, scheme=scheme)
        return stepper, jc.simulate(stepper, steps=30, initial=thrown)

    return run


@pytest.mark.parametrize(
    ("theta", "scheme"), [(0.5, jc.ContactImplicit()), (1.0, jc.BackwardEuler())]
)
def test_contributed_scheme_ends_at_the_two_schemes_that_it_lies_between(
    example, bounce, theta, scheme
):
    (_, motion), (_, expected) = bounce(example["Theta"](theta)), bounce(scheme)
    assert expected.active.any()
    for record in ("displacement", "velocity", "contact_impulse"):
        np.testing.assert_allclose(
            getattr(motion, record), getattr(expected, record), rtol=1e-9, atol=1e-11
        )


def test_contributed_scheme_balances_its_energy(example, bounce):
    ledger = jc.energy(*bounce(example["Theta"](0.7)))
    assert np.sum(ledger.numerical_loss) > 0.01 * ledger.total[0]
    assert np.max(np.abs(ledger.residual)) < 1e-12 * ledger.total[0]
