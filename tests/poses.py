"""Random rigid poses."""

import numpy as np
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.datasets.timed_poses import TimedPoses


def random_pose(rng, reach=5.0):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    pose[:3, 3] = rng.uniform(-reach, reach, 3)
    return pose


def timed(poses, stamps, source="drive"):
    poses = np.asarray(poses)
    return TimedPoses(
        np.asarray(stamps, float),
        poses[:, :3, 3],
        Rotation.from_matrix(poses[:, :3, :3]).as_quat(),
        source,
    )
