"""Exact signed distances to the geoms of a MuJoCo model.

Boxes, spheres, capsules and cylinders have closed forms. The distance to their union is the minimum
over the geoms, exact everywhere outside of solids. Inside a solid the surface of the union may be
farther than that of any one geom, for example where two walls meet. There the value has the right
sign and |value| <= |exact|.
"""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

import mujoco
import numpy as np

from hiosdf_jax._src.numerics.chunks import fill_in_chunks
from hiosdf_jax._src.planning.robot.solids import cylinder_profile, distance_beyond

# Points per chunk: keeps the temporaries at about ten megabytes.
_CHUNK = 4096

# More than rounding adds to the distance of a center, m.
_ROUNDING_M = 1e-9


def signed_distance(
    model: mujoco.MjModel, points_world: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Computes the exact signed distance to the geoms of a model, in its initial configuration.

    Args:
        model: A model of boxes, spheres, capsules and cylinders only.
        points_world: (N, 3) m.

    Returns:
        sdf: (N,) float64, m, positive outside of solids, where it is exact. Inside, the sign is
            right and |sdf| is at most the exact one.
        grad: (N, 3) float64, unit gradient of the nearest geom's distance. Where that has none, for
            example at the center of a sphere, one of its directions of ascent.

    Raises:
        ValueError: `points_world` is not (N, 3) and finite, or the model has no geom, or a geom of
            another type.

    Example:
        distance, gradient = demo.signed_distance(demo.load_model(), np.array([[4.0, 2.0, 1.0]]))
    """
    points = np.asarray(points_world, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points_world has shape {points.shape}, expected (N, 3)")
    if not np.isfinite(points).all():
        row = np.nonzero(~np.isfinite(points).all(axis=1))[0][0]
        raise ValueError(f"points_world[{row}] = {points[row]}, expected finite coordinates")
    if model.ngeom == 0:
        raise ValueError("the model has 0 geoms, expected at least 1")
    for geom, kind in enumerate(model.geom_type.tolist()):
        if kind not in _PRIMITIVES:
            got = mujoco.mjtGeom(kind).name.removeprefix("mjGEOM_").lower()
            raise ValueError(
                f"geom {geom} ({model.geom(geom).name!r}) is of type {got}, "
                "expected box, sphere, capsule or cylinder"
            )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotations = data.geom_xmat.reshape(-1, 3, 3)

    sdf, grad = np.empty(len(points)), np.empty((len(points), 3))
    fill_in_chunks(
        lambda rows: _union(model, data.geom_xpos, rotations, points[rows]),
        {"sdf": sdf, "grad": grad},
        _CHUNK,
        pad=False,
    )
    return sdf, grad


def _union(
    model: mujoco.MjModel, positions: np.ndarray, rotations: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Minimum over the geoms for one chunk; only the nearest geoms' gradients are computed."""
    best, winner = np.full(len(points), np.inf), np.zeros(len(points), int)
    kinds = model.geom_type.tolist()
    # A geom lies in a sphere around its center, which belongs to it: most geoms cannot be nearest.
    to_center = np.sqrt(sum((points[:, k] - positions[:, k, None]) ** 2 for k in range(3)))
    least = to_center - model.geom_rbound[:, None] - _ROUNDING_M
    most = to_center.min(axis=0) + _ROUNDING_M
    for geom, kind in enumerate(kinds):
        rows = np.nonzero(least[geom] <= np.minimum(best, most))[0]
        local = (points[rows] - positions[geom]) @ rotations[geom]
        distance = _PRIMITIVES[kind][0](local, model.geom_size[geom])
        closer = distance < best[rows]
        best[rows[closer]] = distance[closer]
        winner[rows[closer]] = geom
    grad = np.empty((len(points), 3))
    for geom in np.unique(winner):
        won = winner == geom
        local = (points[won] - positions[geom]) @ rotations[geom]
        grad[won] = _PRIMITIVES[kinds[geom]][1](local, model.geom_size[geom]) @ rotations[geom].T
    return best, grad


def _box_distance(p: np.ndarray, half: np.ndarray) -> np.ndarray:
    return distance_beyond(np.abs(p) - half)


def _box_gradient(p: np.ndarray, half: np.ndarray) -> np.ndarray:
    return _cornered_gradient(np.abs(p) - half) * _sign(p)


def _cylinder_distance(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    return distance_beyond(cylinder_profile(p, size[0], size[1]))


def _cylinder_gradient(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    g = _cornered_gradient(cylinder_profile(p, size[0], size[1]))
    radial = _unit(p[:, :2])
    return np.concatenate([g[:, :1] * radial, g[:, 1:] * _sign(p[:, 2:])], axis=1)


def _cornered_gradient(q: np.ndarray) -> np.ndarray:
    """Gradient of `distance_beyond`."""
    # Divided by the largest first: the squares of tiny components would underflow to a norm of 0.
    largest = q.max(axis=1, keepdims=True)
    scaled = np.maximum(q, 0) / np.where(largest > 0, largest, 1)
    nearest_face = np.eye(q.shape[1])[q.argmax(axis=1)]
    ascent = np.where(largest > 0, scaled, nearest_face)
    return ascent / np.linalg.norm(ascent, axis=1, keepdims=True)


def _sphere_distance(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.linalg.norm(p, axis=1) - size[0]


def _sphere_gradient(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    return _unit(p)


def _capsule_distance(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    return np.linalg.norm(_from_axis(p, size), axis=1) - size[0]


def _capsule_gradient(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    return _unit(_from_axis(p, size))


def _from_axis(p: np.ndarray, size: np.ndarray) -> np.ndarray:
    nearest = np.zeros_like(p)
    nearest[:, 2] = np.clip(p[:, 2], -size[1], size[1])
    return p - nearest


def _unit(v: np.ndarray) -> np.ndarray:
    """Unit vectors; the first axis where v is zero."""
    norm = np.linalg.norm(v, axis=1, keepdims=True)
    fallback = np.eye(v.shape[1])[0]
    return np.where(norm > 0, v, fallback) / np.where(norm > 0, norm, 1)


def _sign(x: np.ndarray) -> np.ndarray:
    """Sign with sign(0) = 1: gradients in a plane of symmetry keep their length."""
    return np.where(x < 0, -1.0, 1.0)


# Distance and gradient as functions of (n, 3) points in the geom's frame and its (3,) sizes.
_PRIMITIVES = {
    int(mujoco.mjtGeom.mjGEOM_BOX): (_box_distance, _box_gradient),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): (_sphere_distance, _sphere_gradient),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): (_capsule_distance, _capsule_gradient),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): (_cylinder_distance, _cylinder_gradient),
}
