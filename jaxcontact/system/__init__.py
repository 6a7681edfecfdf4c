"""From a scene to its sparse matrices, and from a system to a reduced one."""
