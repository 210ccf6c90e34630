"""The coarse global grid (paper, section IV-B), one stage a module.

vectors, geometry: components, voxels and metres.  beams: a cloud as rays in the world.  evidence:
what is stored of them, and fades.  surface: hits become a surface patch in each voxel.  rays:
evidence for free and for hidden space.  change: the windows that a cloud can change.  distance:
nearest patch and sign of every voxel.  frontier: distance to unseen space.  lookup: the grid's own
answer at any point.  sampling: what the network is trained on.
"""
