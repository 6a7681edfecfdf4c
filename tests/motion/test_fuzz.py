"""300 random scenes; `benchmarks/fuzz.py` runs any number."""

import pytest
from support import fuzz, fuzz_checks
from support.bodies import SCHEMES

import jaxcontact as jc

#: Kinds that together have every dimension, scheme, solver and precision, cheap to compile.
KINDS = [0, 1, 3, 9, 38, 42]
CASES = 50
#: Those of them that are run one by one too, in a program of their own.
REPEATED = [3, 9]


def test_fuzzed_kinds_have_every_choice():
    kinds = [fuzz.draw_kind(number) for number in KINDS]
    for name, choices in {
        "dimension": {1, 2, 3},
        "scheme": set(SCHEMES),
        "precision": {"float32", "float64"},
        "contact_solver": {"newton", "gauss_seidel", "relaxed"},
        "is_viscous": {True, False},
    }.items():
        assert {getattr(kind, name) for kind in kinds} == choices, name
    assert {type(kind.linear_solver) for kind in kinds} == {
        jc.Dense,
        jc.NestedDissection,
        jc.ConjugateGradient,
    }


@pytest.mark.parametrize("number", KINDS)
def test_random_scenes_move_as_they_must(number):
    kind, report = fuzz.draw_kind(number), fuzz_checks.Report()
    batch = fuzz.run(kind, range(number * CASES, (number + 1) * CASES))
    fuzz_checks.judge(batch, report)
    for k in range(CASES if number in REPEATED else 0):
        fuzz_checks.judge_repeat(batch, k, batch.single, "single", report)
    for k in range(5 if number in REPEATED else 0):
        fuzz_checks.judge_repeat(batch, k, batch.plain, "plain", report)
    assert not report.violations
    # Most cases are judged in full; CG and float32 do not reach all conditions.
    assert report.counts["balance"] > 0.6 * report.counts["status"]
    if kind.precision == "float64":
        assert report.counts["difference"] > 0.3 * report.counts["status"]
