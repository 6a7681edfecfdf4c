"""What the benchmarks share: scenes, exact solutions, and how time is measured and recorded."""
