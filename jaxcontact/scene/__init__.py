"""What the user states: mesh, material, obstacles, how the body is held and loaded."""
