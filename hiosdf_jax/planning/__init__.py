"""What a controller embeds: clearances of robots made of spheres, along motions too, and costs.

clearance: spheres.  sweep: moving spheres.  cost: from clearance to cost.
"""

from hiosdf_jax.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax.planning.cost import collision_cost
from hiosdf_jax.planning.sweep import swept_clearance

__all__ = [
    "collision_cost",
    "sphere_clearance",
    "sphere_clearance_and_grad",
    "swept_clearance",
]
