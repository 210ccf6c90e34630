"""Queries: distances, gradients, lower bounds, baked fields and meshes."""
