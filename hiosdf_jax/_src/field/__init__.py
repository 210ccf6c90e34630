"""Queries: distances, gradients, lower bounds, baked fields and meshes.

`points` has the public queries. It calls `blend` for a live map and `lattice` for a baked field.
"""
