"""A furnished apartment, a depth camera carried through it, and the exact distances it saw."""

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
_PITCH = np.radians(12)  # downwards: furniture is low
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
    """Loads the apartment: about 290 boxes, spheres, capsules and cylinders, none of which moves.

    Returns:
      The model; metres, z up. Geoms less than 5 cm thick have names that begin with "thin_".
    """
    xml = resources.files("hiosdf_jax._src.demo").joinpath("apartment.xml").read_text("utf-8")
    return mujoco.MjModel.from_xml_string(xml)


def camera_path(frames: int) -> np.ndarray:
    """Lays a smooth path through all rooms, on which no obstacle is nearer than 0.3 m.

    Args:
      frames: how many poses, >= 1, of a path of 25.5 m; they lie closer where the camera turns.

    Returns:
      (frames, 4, 4) float64 T_world_sensor, metres; optical frame (x right, y down, z forward).

    Raises:
      ValueError: frames < 1.
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
    # Whoever carries a camera slows down to turn: frames are even in metres plus radians.
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
    """A depth camera that is carried through the apartment; a sequence of (cloud, pose).

    Frames are rendered when they are asked for and depend on the arguments and the index only.
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
        """Prepares the camera; its horizontal field of view is 90 degrees.

        Args:
          frames: length of the stream; the path is the same for any, see `camera_path`.
          width: pixels a row.
          height: pixels a column.
          max_range: metres along a ray; nothing farther, and nothing nearer than 0.3 m, returns.
          seed: of the noise.
          noise: whether depths are noisy (as a Kinect's), some pixels drop out, and some fly
            between foreground and background at depth edges.

        Raises:
          ValueError: frames, width or height < 1, or max_range <= 0.3.
        """
        self.model = load_model()
        self.poses_world_sensor = camera_path(frames)
        self.camera = DepthCamera(self.model, width, height, max_range, noise)
        self.height, self.width = height, width
        self.max_range, self.seed, self.noise = max_range, seed, noise

    def __len__(self) -> int:
        """The number of frames."""
        return len(self.poses_world_sensor)

    def __getitem__(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Renders a frame.

        Args:
          index: 0 <= index < len(self).

        Returns:
          cloud: (height * width, 3) float32, metres, sensor frame, row by row of the image; a row
            of NaN is no return.
          pose: (4, 4) float32, T_world_sensor.

        Raises:
          IndexError: the index is out of range.
        """
        pose = self._pose(index)
        return self.camera.cloud(pose, (self.seed, index)), pose.astype(np.float32)

    def exact_depth(self, index: int) -> np.ndarray:
        """Casts the rays of a frame, with neither noise nor a limit of range.

        Args:
          index: 0 <= index < len(self).

        Returns:
          (height * width,) float64, depth along the optical axis in metres; finite, since the
          apartment is closed.

        Raises:
          IndexError: the index is out of range.
        """
        return self.camera.exact_depth(self._pose(index))

    def exact_surface(self, index: int) -> np.ndarray:
        """Finds the surface points that a frame sees within the camera's limits of range.

        Args:
          index: 0 <= index < len(self).

        Returns:
          (n, 3) float64, metres, world; n <= height * width.

        Raises:
          IndexError: the index is out of range.
        """
        return self.exact_parts(index)[0]

    def exact_parts(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """Finds the surface points that a frame sees, and what they are on.

        Args:
          index: 0 <= index < len(self).

        Returns:
          points_world: (n, 3) float64, metres, those of `exact_surface`.
          geom: (n,) int32, which geom of the model each point is on.

        Raises:
          IndexError: the index is out of range.
        """
        return self.camera.exact_parts(self._pose(index))

    def _pose(self, index: int) -> np.ndarray:
        if not 0 <= index < len(self):
            raise IndexError(f"index = {index}, expected 0 <= index < {len(self)}")
        return self.poses_world_sensor[index]


def ground_truth(stream: ApartmentStream, count: int = 25000, seed: int = 1) -> GroundTruth:
    """Draws points of the free space that a stream sees, with the exact distances there.

    The frame of each point is drawn uniformly, then a pixel of the frame that sees a surface, then
    the place on the ray between the sensor and that surface.

    Args:
      stream: whose exact rays, not its noise, say what is free.
      count: how many points in free space, and how many on surfaces.
      seed: of the draws.

    Returns:
      The exact distances; frame is the one that the point was drawn from. Thin points are up to
      50 of each thin part that at least 10 rays met.

    Raises:
      ValueError: a frame that was drawn sees no surface.
    """
    rng = np.random.default_rng(seed)
    quotas = rng.multinomial(count, np.full(len(stream), 1 / len(stream)), size=2).T
    is_thin = np.array(
        [stream.model.geom(i).name.startswith("thin_") for i in range(stream.model.ngeom)]
    )
    free, surface, frames, thin, part = [], [], [], [], []
    for index, (free_quota, surface_quota) in enumerate(quotas):
        seen, geom = stream.exact_parts(index)
        if not len(seen):
            raise ValueError(f"frame {index} sees no surface within {stream.max_range} m")
        origin = stream.poses_world_sensor[index, :3, 3]
        along = rng.uniform(size=(free_quota, 1))
        free.append(origin + along * (rng.choice(seen, free_quota) - origin))
        surface.append(rng.choice(seen, surface_quota))
        frames.append(np.full(free_quota, index, np.int32))
        thin.append(seen[is_thin[geom]])
        part.append(geom[is_thin[geom]])
    # Rounded before the distance is taken, so that it is exact at the very points handed out.
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
