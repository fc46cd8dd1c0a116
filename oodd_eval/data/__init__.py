"""Data: facts of the benchmark, trajectories, splits on disk, and simulators that record them."""
