"""Queries: distances, gradients, lower bounds, baked fields and meshes.

`queries` has the public ones. It calls `blend` for a live map and `lattice` for a baked field.
"""
