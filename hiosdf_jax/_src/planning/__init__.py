"""Clearances, costs, sweeps, trajectories and robots for controllers."""
