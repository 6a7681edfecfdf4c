"""What JAX lacks: rules and loops that know nothing of contact."""
