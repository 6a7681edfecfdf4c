"""Abaqus decks: every name that a deck gives to nodes, elements and faces is in the mesh."""

import numpy as np
import pytest

from jaxcontact.scene.io import read_mesh

SQUARE = """*HEADING
** the unit square, cut from node 1 to node 3
*NODE, NSET=all
1, 0.0, 0.0
2, 1.0, 0.0
3, 1.0, 1.0
4, 0.0, 1.0
*Element, type=CPE3
20, 1, 2, 3
*ELEMENT, TYPE=CPS3, ELSET=upper
30, 1, 3, 4
"""

# S1 is the face 1-2-3, S2 1-4-2, S3 2-4-3 and S4 3-4-1.
TETRAHEDRON = """*NODE
1, 0, 0, 0
2, 1, 0, 0
3, 0, 1, 0
4, 0, 0, 1
*ELEMENT, TYPE=C3D4H, ELSET=body
5, 1, 2, 3, 4
"""


def read(tmp_path, deck, name="deck.inp"):
    path = tmp_path / name
    path.write_text(deck)
    return read_mesh(path)


def sets(groups):
    return {name: sorted(map(sorted, rows.tolist())) for name, rows in groups.items()}


def test_deck_without_sets_has_its_blocks(tmp_path):
    mesh = read(tmp_path, SQUARE)
    assert mesh.cells.tolist() == [[0, 1, 2], [0, 2, 3]]
    # The set belongs to the second block, not to the first.
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == {"upper": [1]}
    assert sets(mesh.facets) == {"all": [[0, 1], [0, 3], [1, 2], [2, 3]]}


def test_deck_names_facets_by_node_sets(tmp_path):
    deck = SQUARE + "*NSET, NSET=Bottom\n1, 2\n*Nset, nset=rest, generate\n2, 4, 1\n"
    assert sets(read(tmp_path, deck).facets) == {
        "all": [[0, 1], [0, 3], [1, 2], [2, 3]],
        "Bottom": [[0, 1]],
        "rest": [[1, 2], [2, 3]],
    }


def test_deck_node_set_may_name_other_sets_in_any_case(tmp_path):
    deck = SQUARE + "*NSET, NSET=a\n1,\n*NSET, NSET=b\nA, 2\n*NSET, NSET=c, ELSET=UPPER\n"
    with pytest.warns(UserWarning, match="node set 'a' is left out, it holds no whole facet"):
        mesh = read(tmp_path, deck)
    assert sets(mesh.facets)["b"] == [[0, 1]]
    assert sets(mesh.facets)["c"] == [[0, 3], [2, 3]]


def test_deck_names_regions_by_element_sets(tmp_path):
    deck = SQUARE + "*ELSET, ELSET=both\nupper, 20\n*ELSET, ELSET=odd, GENERATE\n20, 20\n"
    mesh = read(tmp_path, deck)
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == {
        "upper": [1],
        "both": [0, 1],
        "odd": [0],
    }


def test_deck_names_facets_by_surfaces_of_triangles(tmp_path):
    deck = SQUARE + (
        "*ELSET, ELSET=_low, INTERNAL\n20,\n"
        "*SURFACE, NAME=low, TYPE=ELEMENT\n_low, S1\n"
        "*SURFACE, NAME=sides\n20, E2\nupper, S3\n"
        "*SURFACE, NAME=outer\nupper,\n"
    )
    mesh = read(tmp_path, deck)
    facets = sets(mesh.facets)
    assert facets["low"] == [[0, 1]]
    assert facets["sides"] == [[0, 3], [1, 2]]
    # The diagonal is no outer face.
    assert facets["outer"] == [[0, 3], [2, 3]]
    assert "_low" not in mesh.regions


@pytest.mark.parametrize(
    ("side", "nodes"),
    [("S1", [0, 1, 2]), ("S2", [0, 1, 3]), ("S3", [1, 2, 3]), ("S4", [0, 2, 3])],
)
def test_deck_numbers_the_faces_of_a_tetrahedron_as_abaqus_does(tmp_path, side, nodes):
    mesh = read(tmp_path, TETRAHEDRON + f"*SURFACE, NAME=face\nbody, {side}\n")
    assert sets(mesh.facets) == {"face": [nodes]}


def test_deck_names_facets_by_surfaces_of_nodes_and_of_skins(tmp_path):
    deck = TETRAHEDRON + (
        "*NSET, NSET=low\n1, 2, 3\n*SURFACE, NAME=floor, TYPE=NODE\nlow,\n"
        "*ELEMENT, TYPE=SFM3D3, ELSET=skin\n9, 2, 3, 4\n*SURFACE, NAME=slope\nskin, SPOS\n"
    )
    mesh = read(tmp_path, deck)
    assert mesh.dimension == 3
    assert sets(mesh.facets) == {
        "low": [[0, 1, 2]],
        "floor": [[0, 1, 2]],
        "skin": [[1, 2, 3]],
        "slope": [[1, 2, 3]],
    }


def test_deck_reads_the_files_that_it_includes(tmp_path):
    (tmp_path / "nodes.inp").write_text(SQUARE)
    mesh = read(tmp_path, "*INCLUDE, INPUT=nodes.inp\n*NSET, NSET=low\n1, 2\n")
    assert sets(mesh.facets)["low"] == [[0, 1]]


def test_deck_of_one_part_is_read_as_a_flat_one(tmp_path):
    deck = f"*PART, NAME=p\n{SQUARE}*END PART\n*ASSEMBLY\n*INSTANCE, NAME=p-1, PART=p\n"
    deck += "*END INSTANCE\n*NSET, NSET=low, INSTANCE=p-1\n1, 2\n*END ASSEMBLY\n"
    mesh = read(tmp_path, deck)
    assert sets(mesh.facets)["low"] == [[0, 1]]
    assert mesh.n_cells == 2


@pytest.mark.parametrize(
    ("deck", "message"),
    [
        (SQUARE.replace("CPE3", "DCOUP3D"), "element type DCOUP3D is not supported; mesh the"),
        (SQUARE.replace("20, 1, 2, 3", "20, 1, 2, 9"), "node 9 is named, but not defined; add it"),
        (SQUARE + "*ELSET, ELSET=a\n99\n", "element 99 is named, but not defined"),
        (SQUARE + "*NSET, NSET=a\nlow\n", r"no node set 'low' is defined; there are \['all'\]"),
        (SQUARE + "*SURFACE, NAME=a\n20, S4\n", "a triangle has no face S4; use"),
        ("*PART, NAME=a\n*PART, NAME=b\n", "2 parts .*write it flat .*noPartsInputFile=ON"),
        ("*INSTANCE, NAME=a\n1.0, 0.0\n", "1 instances, or moves one; write it flat"),
        ("*HEADING\n", r"no \*NODE section; is this an Abaqus deck"),
        (
            SQUARE.replace("20, 1, 2, 3", "20, 1, 2"),
            r"\*ELEMENT: type CPE3 needs 4 numbers per element",
        ),
        (
            SQUARE.replace("0.0, 1.0\n*E", "0.0, x\n*E"),
            r"deck.inp: \*NODE: could not convert .*'x'",
        ),
    ],
)
def test_deck_that_is_refused_says_what_to_do(tmp_path, deck, message):
    with pytest.raises(ValueError, match=message):
        read(tmp_path, deck)


def test_deck_that_includes_a_missing_file_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"there is no file .*nothing\.inc; check its name"):
        read(tmp_path, "*Include, input=nothing.inc")


def test_deck_may_leave_out_zeros_and_have_empty_sections(tmp_path):
    deck = SQUARE.replace("1, 0.0, 0.0", "1").replace("2, 1.0, 0.0", "2, 1.0,")
    mesh = read(tmp_path, deck + "*ELEMENT, TYPE=S3\n")
    assert np.array_equal(mesh.points, [[0, 0], [1, 0], [1, 1], [0, 1]])


def test_deck_and_its_mesh_have_the_same_points(tmp_path):
    assert np.array_equal(read(tmp_path, SQUARE).points, [[0, 0], [1, 0], [1, 1], [0, 1]])
