"""Clearances, costs and trajectories for controllers, and adapters to planning libraries.

Every function takes the map as an argument, so that a controller compiles once for all maps.
The adapters are imported on first use and need their libraries:

    planning.mppi   jax-mppi: MPPI with the map as an argument
    planning.cbf    cbfpy: a safety filter for velocity commands
    planning.frax   frax: whole-arm clearance of a manipulator
    planning.mjx    mujoco-mjx: rollouts of a simulated robot
"""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType
from typing import TYPE_CHECKING

from hiosdf_jax._src.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax._src.planning.cost import collision_cost
from hiosdf_jax._src.planning.robot.spheres import (
    BodyPoses,
    RobotSpheres,
    place_spheres,
    robot_clearance,
    robot_clearance_and_grad,
    spheres_from_model,
)
from hiosdf_jax._src.planning.sweep import swept_clearance, swept_clearance_and_grad
from hiosdf_jax._src.planning.trajectory import Trajectory, optimize_trajectory, waves

if TYPE_CHECKING:
    from hiosdf_jax._src.planning.adapters import cbf as cbf
    from hiosdf_jax._src.planning.adapters import frax as frax
    from hiosdf_jax._src.planning.adapters import mjx as mjx
    from hiosdf_jax._src.planning.adapters import mppi as mppi

__all__ = [
    "BodyPoses",
    "RobotSpheres",
    "Trajectory",
    "collision_cost",
    "optimize_trajectory",
    "place_spheres",
    "robot_clearance",
    "robot_clearance_and_grad",
    "sphere_clearance",
    "sphere_clearance_and_grad",
    "spheres_from_model",
    "swept_clearance",
    "swept_clearance_and_grad",
    "waves",
]

_ADAPTERS = {"cbf": "cbfpy", "frax": "frax", "mjx": "mujoco", "mppi": "jax_mppi"}
"""Adapter -> the module that it needs."""


def __getattr__(name: str) -> ModuleType:
    """Imports an adapter on first use."""
    if name == "trajectory":
        return importlib.import_module("hiosdf_jax._src.planning.trajectory")
    if name not in _ADAPTERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return importlib.import_module(f"hiosdf_jax._src.planning.adapters.{name}")
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{__name__}.{name} needs {_ADAPTERS[name]}, but there is no module {error.name!r}; "
            f"in a clone of hiosdf_jax: pip install '.[plan]'",
            name=error.name,
        ) from error


def __dir__() -> list[str]:
    """Lists the adapters too whose library is installed."""
    adapters = (name for name, library in _ADAPTERS.items() if importlib.util.find_spec(library))
    return sorted({*globals(), *adapters})
