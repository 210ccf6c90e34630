"""Time to cover a mobile manipulator by spheres, and how many it takes.

    python -m benchmarks.robot_cover

The robot has the sizes of a Fetch: 15 meshes with 4 m^2 of faces, some of them hollow.
"""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import argparse
import time
from typing import Any

import mujoco
import numpy as np
import trimesh
from trimesh.creation import annulus, box, capsule, cylinder, icosphere

from hiosdf_jax import planning

ARM_LINKS = 7


def meshes() -> dict[str, Any]:
    """Returns the parts, m, each in its own frame."""
    wheel = cylinder(0.06, 0.05, sections=64)
    shell = annulus(0.24, 0.26, 0.34, sections=128)
    base = [shell, cylinder(0.26, 0.02, sections=128).apply_translation([0, 0, 0.18])]
    base += [
        wheel.copy().apply_translation([0.1 * x, 0.2 * y, -0.15]) for x in (-1, 1) for y in (-1, 1)
    ]
    column = [annulus(0.13, 0.15, 0.55, sections=96), annulus(0.08, 0.1, 0.55, sections=96)]
    head = [box((0.1, 0.28, 0.08)), cylinder(0.05, 0.3, sections=64), icosphere(3, 0.06)]
    parts = {
        "base": base,
        "torso": column,
        "back": [box((0.12, 0.3, 0.01)), box((0.01, 0.3, 0.44)), cylinder(0.05, 0.44, sections=48)],
        "neck": head[:2],
        "head": head[2:],
        "estop": [cylinder(0.016, 0.04, sections=512)],
        "laser": [cylinder(0.035, 0.04, sections=512)],
        "gripper": [box((0.08, 0.12, 0.05)), box((0.06, 0.02, 0.06))],
    }
    for k in range(ARM_LINKS):
        link = [capsule(0.14 - 0.008 * k, 0.055 - 0.003 * k, count=[24, 24])]
        link.append(cylinder(0.05 - 0.003 * k, 0.11 - 0.005 * k, sections=48))
        parts[f"link{k}"] = link
    return {name: trimesh.util.concatenate(part) for name, part in parts.items()}


def mobile_manipulator() -> mujoco.MjModel:
    """Returns a base that moves in the plane, with a torso, a head, an arm and two fingers."""
    spec = mujoco.MjSpec()
    for name, mesh in meshes().items():
        added = spec.add_mesh(name=name)
        added.uservert, added.userface = mesh.vertices.ravel(), mesh.faces.ravel()

    def add(parent: mujoco.MjsBody, name: str, height: float, *shapes: str) -> mujoco.MjsBody:
        body = parent.add_body(name=name, pos=[0, 0, height])
        body.add_joint(axis=[0, 0, 1])
        for shape in shapes:
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=shape)
        return body

    base = add(spec.worldbody, "base", 0.2, "base", "estop", "laser", "back")
    torso = add(base, "torso", 0.4, "torso")
    add(add(torso, "neck", 0.4, "neck"), "head", 0.1, "head")
    link = torso
    for k in range(ARM_LINKS):
        link = add(link, f"link{k}", 0.15, f"link{k}")
    hand = add(link, "hand", 0.12, "gripper")
    for side in (-1, 1):
        finger = hand.add_body(pos=[0, 0.04 * side, 0.06])
        finger.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, side, 0])
        finger.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.012, 0.007, 0.03])
    return spec.compile()


def main() -> None:
    """Prints the robot's size, and number of spheres and times."""
    parser = argparse.ArgumentParser(description="Times the cover of a robot by spheres.")
    parser.add_argument("--model", help="an XML file instead of the built robot")
    parser.add_argument("--tolerance", type=float, default=0.02, help="m (default: %(default)s)")
    arguments = parser.parse_args()
    model = arguments.model or mobile_manipulator()
    if not arguments.model:
        area = sum(mesh.area for mesh in meshes().values())
        print(f"{model.ngeom} geoms, {model.nmeshface} triangles, {area:.1f} m^2")
    planning.spheres_from_model(model, 10.0)  # imports what it needs
    wall, cpu = time.perf_counter(), time.process_time()
    spheres = planning.spheres_from_model(model, arguments.tolerance)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    protruding = f"{100 * arguments.tolerance:g} cm"
    print(f"{np.size(spheres.radii)} spheres at {protruding}: {wall:.1f} s, {cpu:.1f} s of CPU")


if __name__ == "__main__":
    main()
