"""How accurate a simulation is: the error of a reduced model, of mesh and time step; advice."""
