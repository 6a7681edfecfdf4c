"""Damaged files: every reader ends, with a result or an error that it documents."""

import pytest
from support import damage


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return damage.whole_files(tmp_path_factory.mktemp("whole"))


def test_every_whole_file_is_read(whole, tmp_path):
    for name, content in whole.items():
        path = tmp_path / name
        path.write_bytes(content)
        assert damage.read(path) == "read", name


def test_damaged_files_end_with_a_result_or_a_documented_error(tmp_path):
    # 540 files, 30 of each kind; `benchmarks/fuzz.py` reads 20 000.
    endings, leaks = damage.fuzz_files(tmp_path, range(540))
    assert not leaks
    assert 0.05 < sum(n for name, n in endings.items() if name.endswith("read")) / 540 < 0.5


def test_no_reader_waits_for_the_rest_of_a_file(whole, tmp_path):
    # Some readers of meshio ask for ever for the next line.
    for name in ("solid.nas", "solid.mdpa", "solid.tec", "surface.off", "surface.ply"):
        path = tmp_path / name
        for size in range(0, len(whole[name]), 7):
            path.write_bytes(whole[name][:size])
            assert isinstance(damage.read(path), (str, *damage.DOCUMENTED)), (name, size)


@pytest.mark.parametrize("seed", [9111, 19339, 9436])
def test_files_that_once_broke_a_reader_end_with_a_documented_error(tmp_path, seed):
    # A range of four numbers, no table of nodes, and a node of the number 2e9.
    endings, leaks = damage.fuzz_files(tmp_path, [seed])
    assert not leaks
    assert all(name.endswith("ValueError") for name in endings)
