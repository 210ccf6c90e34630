"""Clearances, costs and trajectories for controllers, and adapters to planning libraries.

Every function takes the map as an argument, so that a controller compiles once for all maps.
The adapters are imported on first use and need their libraries:

    planning.mppi   jax-mppi: MPPI with the map as an argument
    planning.cbf    cbfpy: a safety filter for velocity commands
    planning.frax   frax: whole-arm clearance of a manipulator
    planning.mjx    mujoco-mjx: rollouts of a simulated robot
    planning.jaxls  jaxls: hard constraints and costs of clearance, for least squares
    planning.pyroki pyroki: the collision spheres of its robots
    planning.hydrax hydrax: sampling-based control with the map as an argument
"""

from __future__ import annotations

import importlib
import importlib.util
from types import ModuleType
from typing import TYPE_CHECKING

from hiosdf_jax._src.planning.body import clearance_and_jacobian
from hiosdf_jax._src.planning.clearance import sphere_clearance, sphere_clearance_and_grad
from hiosdf_jax._src.planning.cost import collision_cost
from hiosdf_jax._src.planning.robot.clearance import robot_clearance, robot_clearance_and_grad
from hiosdf_jax._src.planning.robot.spheres import (
    BodyPoses,
    RobotSpheres,
    place_spheres,
    spheres_from_model,
)
from hiosdf_jax._src.planning.sweep import swept_clearance, swept_clearance_and_grad
from hiosdf_jax._src.planning.trajectory import Trajectory, optimize_trajectory, waves

if TYPE_CHECKING:
    from hiosdf_jax._src.planning.adapters import cbf as cbf
    from hiosdf_jax._src.planning.adapters import frax as frax
    from hiosdf_jax._src.planning.adapters import hydrax as hydrax
    from hiosdf_jax._src.planning.adapters import jaxls as jaxls
    from hiosdf_jax._src.planning.adapters import mjx as mjx
    from hiosdf_jax._src.planning.adapters import mppi as mppi
    from hiosdf_jax._src.planning.adapters import pyroki as pyroki

__all__ = [
    "BodyPoses",
    "RobotSpheres",
    "Trajectory",
    "clearance_and_jacobian",
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

_ADAPTERS = {
    "cbf": "cbfpy",
    "frax": "frax",
    "hydrax": "hydrax",
    "jaxls": "jaxls",
    "mjx": "mujoco",
    "mppi": "jax_mppi",
    "pyroki": "pyroki",
}
"""Adapter -> the module that it needs."""

_REPOSITORIES = {
    "hydrax": "https://github.com/vincekurtz/hydrax.git",
    "jaxls": "https://github.com/brentyi/jaxls.git",
    "pyroki": "https://github.com/chungmin99/pyroki.git",
}
"""Adapter -> its library's repository. A package of that name on PyPI is another one."""


def __getattr__(name: str) -> ModuleType:
    """Imports an adapter on first use."""
    if name not in _ADAPTERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        return importlib.import_module(f"hiosdf_jax._src.planning.adapters.{name}")
    except ImportError as error:
        if name in _REPOSITORIES:
            how = f"{error}; pip install 'git+{_REPOSITORIES[name]}'"
        elif isinstance(error, ModuleNotFoundError):
            how = (
                f"there is no module {error.name!r}; "
                f"in a clone of hiosdf_jax: pip install '.[plan]'"
            )
        else:
            raise
        raise ModuleNotFoundError(
            f"{__name__}.{name} needs {_ADAPTERS[name]}, but {how}", name=error.name
        ) from error


def __dir__() -> list[str]:
    """Lists the public names alone, and the adapters whose library is installed."""
    adapters = (name for name, library in _ADAPTERS.items() if importlib.util.find_spec(library))
    special = (name for name in globals() if name.startswith("__"))
    return sorted({*__all__, *adapters, *special})
