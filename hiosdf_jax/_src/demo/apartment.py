"""A furnished apartment, a depth camera carried through it, and exact distances where it saw."""

# mujoco's bindings carry no types that pyright can see.
# pyright: reportAttributeAccessIssue=false

from importlib import resources

import mujoco
import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from hiosdf_jax._src.datasets.truth import GroundTruth, choose_thin
from hiosdf_jax._src.demo.camera import DepthCamera
from hiosdf_jax._src.demo.primitives import signed_distance

# The rooms span (0, 0, 0) to (10, 8, 2.6) m and the walls are 0.15 m thick.
BOUNDS_WORLD = ((-0.2, -0.2, -0.2), (10.2, 8.2, 2.8))  # m

_CAMERA_HEIGHT = 1.2  # m
_PITCH = np.radians(12)  # downward: furniture is low
# x (m), y (m), and the gaze relative to the direction of travel (degrees, positive to the left).
_WAYPOINTS = np.array(
    [
        # living room
        (4.55, 3.45, 0),
        (3.75, 3.35, -35),
        (3.05, 2.75, -20),
        (2.95, 1.95, 35),
        (3.45, 1.40, 15),
        (4.40, 1.32, 60),
        (5.05, 1.32, 10),
        (5.65, 1.325, 0),  # door
        # kitchen
        (6.30, 1.32, 20),
        (7.10, 1.30, -50),
        (7.90, 1.30, 35),
        (8.70, 1.38, 10),
        (9.25, 1.95, 40),
        (9.35, 2.80, 75),
        (9.35, 3.60, 25),
        (9.375, 4.45, 0),  # door
        # hall
        (9.20, 5.20, 20),
        (8.80, 6.05, -25),
        (8.25, 6.60, -40),
        (7.45, 6.775, -10),  # door
        # bedroom
        (6.80, 6.60, 15),
        (6.35, 6.00, 35),
        (5.60, 5.55, 10),
        (4.75, 5.50, -45),
        (3.95, 5.50, -30),
        (3.25, 5.475, -35),  # door
        # study
        (2.65, 5.65, -75),
        (2.10, 5.85, -75),
        (1.60, 5.70, -65),
        (1.40, 5.15, -35),
        (1.375, 4.45, 0),  # door
        # living room again
        (1.60, 3.95, -20),
        (2.20, 3.70, -30),
        (2.90, 3.60, -20),
        (3.50, 3.60, 0),
    ]
)


def load_model() -> mujoco.MjModel:
    """Loads the apartment: about 290 static boxes, spheres, capsules and cylinders.

    Returns:
        The model, in m, z up. The names of geoms less than 5 cm thick start with "thin_".

    Example:
        model = demo.load_model()
        distance, _ = demo.signed_distance(model, np.array([[4.0, 2.0, 1.0]]))
    """
    xml = resources.files("hiosdf_jax._src.demo").joinpath("apartment.xml").read_text("utf-8")
    return mujoco.MjModel.from_xml_string(xml)


def camera_path(frames: int) -> np.ndarray:
    """Lays a smooth path of 25.5 m through all rooms, at least 0.3 m from every obstacle.

    Args:
        frames: Number of poses, >= 1; they lie closer where the camera turns.

    Returns:
        (frames, 4, 4) float64 T_world_sensor, m; optical frame (x right, y down, z forward).

    Raises:
        ValueError: `frames` < 1.

    Example:
        poses_world_sensor = demo.camera_path(frames=80)
    """
    if frames < 1:
        raise ValueError(f"frames = {frames}, expected >= 1")
    chords = np.linalg.norm(np.diff(_WAYPOINTS[:, :2], axis=0), axis=1)
    knots = np.concatenate([[0], np.cumsum(chords)])
    position = CubicSpline(knots, _WAYPOINTS[:, :2])
    gaze = PchipInterpolator(knots, _WAYPOINTS[:, 2])

    dense = np.linspace(0, knots[-1], 8001)
    xy, velocity = position(dense), position(dense, 1)
    yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0])) + np.radians(gaze(dense))
    # A person who carries a camera slows down to turn: frames are even in meters plus radians.
    steps = np.linalg.norm(np.diff(xy, axis=0), axis=1) + np.abs(np.diff(yaw))
    pace = np.concatenate([[0], np.cumsum(steps)])
    even = np.linspace(0, pace[-1], frames)
    x, y, yaw = (np.interp(even, pace, values) for values in (xy[:, 0], xy[:, 1], yaw))

    cos, sin, zero = np.cos(yaw), np.sin(yaw), np.zeros(frames)
    forward = np.stack([cos, sin, np.full(frames, -np.tan(_PITCH))], axis=1) * np.cos(_PITCH)
    right = np.stack([sin, -cos, zero], axis=1)

    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 0] = right
    poses[:, :3, 1] = np.cross(forward, right)
    poses[:, :3, 2] = forward
    poses[:, :3, 3] = np.stack([x, y, np.full(frames, _CAMERA_HEIGHT)], axis=1)
    return poses


class ApartmentStream:
    """A depth camera carried through the apartment; a sequence of (cloud, pose).

    Frames are rendered on access and depend on the arguments and the index only.

    Attributes:
        model: The apartment, `mujoco.MjModel`.
        poses_world_sensor: (frames, 4, 4) float64 T_world_sensor, m.
        camera: The depth camera.
        max_range: Largest range of a return, m.
    """

    def __init__(
        self,
        frames: int = 80,
        width: int = 160,
        height: int = 120,
        max_range: float = 6.0,
        seed: int = 0,
        noise: bool = True,
    ) -> None:
        """Prepares the camera, whose horizontal field of view is 90 degrees.

        Args:
            frames: Length of the stream. The path does not depend on it, see `camera_path`.
            width: Pixels per row.
            height: Pixels per column.
            max_range: Largest range of a return, m. The least is 0.3 m.
            seed: Seed of the noise.
            noise: Whether depths have a Kinect's noise, some pixels drop out, and some fly between
                foreground and background at depth edges.

        Raises:
            ValueError: `frames`, `width` or `height` < 1, or `max_range` <= 0.3.
        """
        self.model = load_model()
        self.poses_world_sensor = camera_path(frames)
        self.camera = DepthCamera(self.model, width, height, max_range, noise)
        self.max_range, self.seed = max_range, seed

    def __len__(self) -> int:
        """Returns the number of frames."""
        return len(self.poses_world_sensor)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Renders a frame.

        Args:
            index: 0 <= index < len(self).

        Returns:
            cloud: (height * width, 3) float32, m, sensor frame, row-major; a row of NaN is no
                return.
            pose: (4, 4) float32, T_world_sensor.

        Raises:
            IndexError: The index is out of range.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"index = {index}, expected 0 <= index < {len(self)}")
        pose = self.poses_world_sensor[index]
        return self.camera.cloud(pose, (self.seed, index)), pose.astype(np.float32)


def sample_truth(stream: ApartmentStream, count: int = 25000, seed: int = 1) -> GroundTruth:
    """Draws points of the free space that a stream observes, with the exact distances there.

    Each point lies on a ray between the sensor and a surface: its frame, pixel and place on the ray
    are drawn uniformly.

    Args:
        stream: The stream; its exact rays, without noise, define free space.
        count: Number of points in free space, and of points on surfaces.
        seed: Seed of the draws.

    Returns:
        The exact distances, each with the frame that its point was drawn from. Thin points are up
        to 50 per thin part that at least 10 rays hit.

    Raises:
        ValueError: A frame sees no surface.

    Example:
        truth = demo.sample_truth(demo.ApartmentStream(frames=80))
        scores = scoring.evaluate(lambda points: hio.sdf_and_grad(field, points), truth)
    """
    rng = np.random.default_rng(seed)
    quotas = rng.multinomial(count, np.full(len(stream), 1 / len(stream)), size=2).T
    is_thin = np.array(
        [stream.model.geom(i).name.startswith("thin_") for i in range(stream.model.ngeom)]
    )
    free, surface, frames, thin, part = [], [], [], [], []
    for index, (free_quota, surface_quota) in enumerate(quotas):
        pose = stream.poses_world_sensor[index]
        seen, geom = stream.camera.exact_surface(pose)
        if not len(seen):
            raise ValueError(f"frame {index} sees no surface within {stream.max_range} m")
        origin = pose[:3, 3]
        along = rng.uniform(size=(free_quota, 1))
        free.append(origin + along * (rng.choice(seen, free_quota) - origin))
        surface.append(rng.choice(seen, surface_quota))
        frames.append(np.full(free_quota, index, np.int32))
        thin.append(seen[is_thin[geom]])
        part.append(geom[is_thin[geom]])
    # Rounded first, so that the distances are exact at the points that are returned.
    points = np.concatenate(free).astype(np.float32)
    sdf, grad = signed_distance(stream.model, points)
    chosen = choose_thin(np.concatenate(part), rng)
    return GroundTruth(
        points_world=points,
        sdf=sdf.astype(np.float32),
        grad=grad.astype(np.float32),
        frame=np.concatenate(frames),
        surface_points_world=np.concatenate(surface).astype(np.float32),
        thin_points_world=np.concatenate(thin)[chosen].astype(np.float32),
    )
