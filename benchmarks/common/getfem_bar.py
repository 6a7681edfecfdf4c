"""The free bar against a wall, computed with GetFEM; a program of its own, run by its Python.

Reads a JSON record {n, length, young, density, gap, speed, dt, steps, scheme} from the standard
input and writes {displacement, impulse, seconds} to the file named as argument. GetFEM assembles
the matrices and solves the contact problem of every step (its basic contact brick, its Newton
method and MUMPS); the schemes are those of `jaxcontact`, written in terms of the new displacement.
Needs NumPy and GetFEM only.
"""

import json
import sys
import time

import getfem as gf
import numpy as np


def matrices(n, length, young, density):
    """Return mass and stiffness of n equal cells, and nodes."""
    mesh = gf.Mesh("cartesian", np.linspace(0.0, length, n + 1))
    fem = gf.MeshFem(mesh, 1)
    fem.set_fem(gf.Fem("FEM_PK(1,1)"))
    method = gf.MeshIm(mesh, gf.Integ("IM_GAUSS1D(4)"))
    mass = gf.asm_mass_matrix(method, fem)
    mass.scale(density)
    stiffness = gf.asm_laplacian(method, fem, fem, np.full(fem.nbdof(), young))
    return fem, mass, stiffness


def main():
    """Run the record on the standard input."""
    record = json.load(sys.stdin)
    dt, steps = record["dt"], record["steps"]
    names = ("n", "length", "young", "density")
    fem, mass, stiffness = matrices(*(record[name] for name in names))
    size = fem.nbdof()
    place = fem.basic_dof_nodes()[0]
    left = int(np.argmin(place))

    model = gf.Model("real")
    model.add_fem_variable("u", fem)
    scaled = gf.Spmat("copy", stiffness)
    scaled.scale(dt**2 / 4)
    step_matrix = gf.Spmat("add", mass, scaled)
    model.add_explicit_matrix("u", "u", step_matrix)
    brick = model.add_explicit_rhs("u", np.zeros(size))
    normal = gf.Spmat("empty", 1, size)
    normal.add(0, left, -1.0)
    model.add_variable("multiplier", 1)
    model.add_initialized_data("r", [record["young"] / record["length"] * dt**2])
    model.add_initialized_data("distance", [record["gap"]])
    model.add_basic_contact_brick("u", "multiplier", "r", normal, "distance")

    y, v, force = np.zeros(size), np.full(size, -record["speed"]), 0.0
    displacement, impulse = [y], []
    start = time.perf_counter()
    for _ in range(steps):
        inertia = mass.mult(y + dt * v) - scaled.mult(y)
        if record["scheme"] == "Trapezoidal":
            inertia[left] += dt**2 / 4 * force
        model.set_private_rhs(brick, inertia)
        model.solve("max_res", 1e-11, "lsolver", "mumps")
        new = model.variable("u")
        # The brick's multiplier is not positive; it is that of the step's row.
        multiplier = -float(model.variable("multiplier")[0])
        if record["scheme"] == "Trapezoidal":
            new_force = 4 / dt**2 * multiplier
            impulse.append(dt / 2 * (force + new_force))
            force = new_force
        else:
            impulse.append(2 / dt * multiplier)
        v = 2 / dt * (new - y) - v
        y = new
        displacement.append(y)
    seconds = time.perf_counter() - start
    order = np.argsort(place)
    record = {
        "displacement": np.array(displacement)[:, order].tolist(),
        "impulse": impulse,
        "seconds": seconds,
    }
    with open(sys.argv[1], "w") as file:
        json.dump(record, file)


if __name__ == "__main__":
    main()
