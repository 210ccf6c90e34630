"""The coarse global grid (paper, section IV-B), one stage a module.

geometry: voxels and metres.  surface: hits become a surface patch in each voxel.  rays: evidence
for free and for hidden space.  distance: nearest patch and sign of every voxel.  lookup: the
grid's own answer at any point.  sampling: what the network is trained on.
"""
