"""Calibrates the pose of a camera on its robot from ten frames, by gradients through `update`.

    python examples/calibrate_extrinsics.py

The robot knows its own poses, and where on it the camera sits up to 3 cm and 2 degrees. Five frames
make a map, and the returns of the other five should lie on its surfaces. Both depend on the guess:
the distances of the returns are differentiated through the map that they are measured in.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import hiosdf_jax as hio
from hiosdf_jax import demo

STEPS = 12
RETURNS = 400  # of each frame, that are measured
TOLERANCE_M = 0.03  # larger distances count less


def rigid(rotvec, shift):
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(rotvec).as_matrix(), shift
    return pose


@jax.jit
def moved(pose, twist):
    """A pose after a small motion (rotation vector in rad, shift in m) in its own frame."""
    x, y, z = twist[:3]
    cross = jnp.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = jnp.eye(3) + cross + 0.5 * cross @ cross
    turn = 1.5 * turn - 0.5 * turn @ turn.T @ turn  # a rotation to rounding
    motion = jnp.eye(4).at[:3, :3].set(turn).at[:3, 3].set(twist[3:])
    return jnp.matmul(pose, motion, precision="highest")


def distances(empty, frames, camera, twist):
    """How far the returns of half of the frames are from the map of the other half, m."""
    (clouds, robots), (others, other_robots) = frames
    camera = moved(camera, twist)

    def add(state, frame):
        cloud, robot = frame
        return hio.update(state, cloud, jnp.matmul(robot, camera, precision="highest")), None

    state, _ = jax.lax.scan(add, empty, (clouds, robots))
    poses = jnp.matmul(other_robots, camera, precision="highest")
    points = jnp.sum(others[:, :, None] * poses[:, None, :3, :3], axis=-1) + poses[:, None, :3, 3]
    return hio.sdf(state, points).ravel()


@jax.jit
def improve(empty, frames, camera):
    """One Gauss-Newton step."""
    measure = functools.partial(distances, empty, frames, camera)
    still = jnp.zeros(6)
    away, slopes = measure(still), jax.jacfwd(measure)(still)
    weight = 1 / (1 + (away / TOLERANCE_M) ** 2)
    normal = (slopes * weight[:, None]).T @ slopes + 1e-3 * jnp.eye(6)
    twist = -jnp.linalg.solve(normal, (slopes * weight[:, None]).T @ away)
    return moved(camera, twist)


def main():
    stream = demo.ApartmentStream(80)
    exact = rigid([0.1, -0.2, 0.3], [0.2, 0.05, 0.4])  # T_robot_camera
    # The network takes no part: the grid answers alone, and carries the gradient.
    config = hio.Config.light(
        demo.BOUNDS_WORLD,
        max_range=stream.max_range,
        max_points=6000,
        grid_share=1.0,
        hidden_width=16,
        hidden_layers=1,
        epochs=1,
        warmup_epochs=1,
    )
    rng = np.random.default_rng(0)
    clouds, others, robots = [], [], []
    for i in range(0, 20, 2):
        cloud, pose = stream[i]
        robots.append(pose @ np.linalg.inv(exact))
        clouds.append(hio.pad_cloud(config, cloud))
        rows = cloud[np.isfinite(cloud).all(axis=1)]
        others.append(rng.choice(rows, RETURNS, replace=False))
    parts = [jnp.asarray(np.stack(part), jnp.float32) for part in (clouds, robots, others)]
    clouds, robots, others = parts
    frames = (clouds[::2], robots[::2]), (others[1::2], robots[1::2])
    empty = hio.init(config, jax.random.key(0))

    camera = jnp.asarray(exact @ rigid([0.02, -0.02, 0.021], [0.02, -0.015, 0.017]), jnp.float32)
    for step in range(STEPS + 1):
        error = np.linalg.inv(exact) @ np.asarray(camera, float)
        way_cm = 100 * np.linalg.norm(error[:3, 3])
        angle_deg = np.degrees(np.linalg.norm(Rotation.from_matrix(error[:3, :3]).as_rotvec()))
        print(f"step {step}: off by {way_cm:.2f} cm and {angle_deg:.3f} degrees", flush=True)
        if step < STEPS:
            camera = improve(empty, frames, camera)


if __name__ == "__main__":
    main()
