"""One sentence for every option that is not an object of the right kind."""

import re
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import pytest

import jaxcontact as jc
from jaxcontact.transforms.options import check_option


@runtime_checkable
class Solver(Protocol):
    @property
    def is_exact(self) -> bool: ...

    def solve(self, x: float) -> float: ...


@runtime_checkable
class Obstacle(Protocol):
    def signed_distance(self, x: float) -> float: ...


@dataclass(frozen=True)
class Halve:
    is_exact: bool = True

    def solve(self, x):
        return x / 2


class Text(str):
    is_exact = True

    def solve(self, x):
        return x


@dataclass(frozen=True)
class OnlySolves:
    def solve(self, x):
        return x


def message(value, protocol=Solver):
    with pytest.raises(ValueError, match="solver must be an object") as caught:
        check_option("solver", value, protocol, "Newton()")
    return str(caught.value)


def test_check_option_accepts_an_object_with_what_the_protocol_asks_for():
    check_option("solver", Halve(), Solver, "Newton()")
    check_option("solver", 3, (Solver, int), "Newton()")


@pytest.mark.parametrize("value", ["newton", Text("newton"), 3, None, OnlySolves()], ids=repr)
def test_check_option_says_what_to_write_instead_of_a_value(value):
    assert message(value) == f"solver must be an object, such as jc.Newton(), got {value!r}"


def test_check_option_names_a_class_that_only_misses_its_parentheses():
    assert message(Halve) == "solver must be an object, such as Halve(), got the class Halve"
    assert "such as jc.Newton(), got the class int" in message(int)


def test_check_option_writes_jc_before_a_public_class():
    text = message(jc.HalfSpace, (Solver, Obstacle))
    assert "such as jc.HalfSpace(), got the class HalfSpace" in text


def test_check_option_quotes_a_large_value_in_one_short_line():
    text = message([list(range(50))] * 50)
    assert re.search(r"got \[\[0, 1.* \.\.\.$", text)
    assert "\n" not in text
    assert len(text) < 200
