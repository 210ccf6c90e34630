"""What a controller embeds: clearances of robots made of spheres, along motions too, and costs.

clearance: spheres.  sweep: moving spheres.  cost: from clearance to cost.  robot: a MuJoCo model's
geoms as spheres, by the covers of cover and solids.
"""

from hiosdf_jax._src.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax._src.planning.cost import collision_cost
from hiosdf_jax._src.planning.robot.spheres import (
    BodyPoses,
    RobotSpheres,
    place_spheres,
    robot_clearance,
    spheres_from_model,
)
from hiosdf_jax._src.planning.sweep import swept_clearance

__all__ = [
    "BodyPoses",
    "RobotSpheres",
    "collision_cost",
    "place_spheres",
    "robot_clearance",
    "sphere_clearance",
    "sphere_clearance_and_grad",
    "spheres_from_model",
    "swept_clearance",
]
