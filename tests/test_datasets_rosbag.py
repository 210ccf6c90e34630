"""ROS 1 and ROS 2 bags, written here, against the closed form of the motion in them."""

import re
import tracemalloc
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hiosdf_jax._src.datasets.rosbag import cloud_of
from hiosdf_jax.datasets import BadFrameError, NoPosesError, find_bounds, open_stream, read_frame

rosbags = pytest.importorskip("rosbags")
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

START = 1_700_000_000  # s
CLOUDS = np.random.default_rng(0).uniform(-3, 3, (5, 20, 3)).astype(np.float32)
STAMPS = START + 0.13 + 0.1 * np.arange(5)
TURN = 0.7  # rad/s
MOUNT = np.eye(4)
MOUNT[:3, :3] = Rotation.from_euler("xyz", [0.1, -0.2, 1.5]).as_matrix()
MOUNT[:3, 3] = [0.3, -0.1, 0.5]
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("gap", "V4"), ("z", "<f4"), ("ring", "<u2")])


def motion(stamp):
    """The base in the odometry frame; the motion is uniform, so interpolation is exact."""
    time, pose = stamp - START, np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec([0, 0, TURN * time]).as_matrix()
    pose[:3, 3] = [1.5 * time, 2, -0.5 * time]
    return pose


class Bag:
    """Writes messages; `kind` is ros1, sqlite3 or mcap."""

    def __init__(self, path, kind):
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        tf = "tf2_msgs/msg/TFMessage"
        if kind == "ros1":
            self.store.register(
                get_types_from_msg("geometry_msgs/TransformStamped[] transforms", tf)
            )
        if kind == "ros1":
            self.path = path.with_suffix(".bag")
            self.writer = Writer1(self.path)
        else:
            self.path = path
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self.writer = Writer2(self.path, version=9, storage_plugin=plugin)
        self.connections = {}

    def __enter__(self):
        self.writer.open()
        return self

    def __exit__(self, *_):
        self.writer.close()

    def make(self, msgtype, /, **fields):
        return self.store.types[msgtype](**fields)

    def header(self, stamp, frame):
        seconds, nanoseconds = divmod(round(stamp * 1e9), 10**9)
        time = self.make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
        sequence = {"seq": 0} if self.kind == "ros1" else {}
        return self.make("std_msgs/msg/Header", stamp=time, frame_id=frame, **sequence)

    def write(self, topic, stamp, message):
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        self.writer.write(self.connections[topic], round(stamp * 1e9), serialize(message, name))

    def write_cloud(self, stamp, cloud, frame="lidar", topic="/points", recorded=None):
        points = np.zeros(len(cloud), POINT)
        points["x"], points["y"], points["z"] = cloud.T
        fields = [
            self.make("sensor_msgs/msg/PointField", name=n, offset=o, datatype=d, count=1)
            for n, o, d in [("x", 0, 7), ("y", 4, 7), ("z", 12, 7), ("ring", 16, 4)]
        ]
        message = self.make(
            "sensor_msgs/msg/PointCloud2",
            header=self.header(stamp, frame),
            height=1,
            width=len(cloud),
            fields=fields,
            is_bigendian=False,
            point_step=POINT.itemsize,
            row_step=POINT.itemsize * len(cloud),
            data=np.frombuffer(points.tobytes(), np.uint8),
            is_dense=False,
        )
        self.write(topic, stamp + 0.05 if recorded is None else recorded, message)

    def parts(self, pose):
        x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
        rotation = self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)
        return dict(zip("xyz", pose[:3, 3], strict=True)), rotation

    def write_transform(self, stamp, parent, child, pose, topic="/tf"):
        position, rotation = self.parts(pose)
        vector = self.make("geometry_msgs/msg/Vector3", **position)
        transform = self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(stamp, parent),
            child_frame_id=child,
            transform=self.make(
                "geometry_msgs/msg/Transform", translation=vector, rotation=rotation
            ),
        )
        self.write(topic, stamp, self.make("tf2_msgs/msg/TFMessage", transforms=[transform]))

    def write_odometry(self, stamp, parent, child, pose, topic="/odometry"):
        position, rotation = self.parts(pose)
        place = self.make(
            "geometry_msgs/msg/Pose",
            position=self.make("geometry_msgs/msg/Point", **position),
            orientation=rotation,
        )
        zero = self.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        unknown = np.zeros(36)
        message = self.make(
            "nav_msgs/msg/Odometry",
            header=self.header(stamp, parent),
            child_frame_id=child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=place, covariance=unknown),
            twist=self.make(
                "geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=unknown
            ),
        )
        self.write(topic, stamp, message)


def write_bag(path, kind, *, clouds=True, static=True, moving="tf", until=1.0):
    with Bag(path, kind) as bag:
        if static:
            bag.write_transform(START, "base", "lidar", MOUNT, "/tf_static")
        for time in np.arange(START, START + until, 0.07):
            if "tf" in moving:
                bag.write_transform(time, "odom", "base", motion(time))
            if "odometry" in moving:
                bag.write_odometry(time, "odom", "base", motion(time))
        if clouds:
            for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
                bag.write_cloud(stamp, cloud)
    return bag.path


def check_stream(stream):
    assert len(stream) == 5
    for i in (3, 0, 4, 1, 2):  # in any order
        cloud, pose = stream[i]
        np.testing.assert_array_equal(cloud, CLOUDS[i])
        np.testing.assert_allclose(pose, motion(STAMPS[i]) @ MOUNT, atol=2e-6)
    assert len(list(stream)) == 5


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
@pytest.mark.parametrize("moving", ["tf", "odometry"])
def test_bags(tmp_path, kind, moving):
    path = write_bag(tmp_path / "drive", kind, moving=moving)
    check_stream(open_stream(path))
    if kind != "ros1":  # a single file of the folder
        [file] = [each for each in path.iterdir() if each.suffix in (".db3", ".mcap")]
        check_stream(open_stream(file))


def test_map_corrections_above_the_odometry(tmp_path):
    correction = motion(START + 3)
    path = write_bag(tmp_path / "drive", "ros1", moving="tf")
    with Bag(tmp_path / "two", "sqlite3") as bag:
        for time in np.arange(START, START + 1, 0.1):
            bag.write_transform(time, "/map", "/odom", correction)
            bag.write_transform(time, "odom", "base", motion(time))
        bag.write_transform(START, "base", "lidar", MOUNT, "/tf_static")
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud, "/lidar")
    np.testing.assert_allclose(
        open_stream(bag.path)[2][1], correction @ motion(STAMPS[2]) @ MOUNT, atol=1e-5
    )
    check_stream(open_stream(bag.path, world_frame="odom"))
    for name in ("odom", "/odom"):
        check_stream(open_stream(path, world_frame=name))
    for name, message in (
        ("earth", "frame 'earth' is not above 'lidar', expected one of"),
        ("lidar", "world_frame = 'lidar', which is the clouds' own and moves; expected one of"),
        (5, "world_frame is 5, expected a frame's name"),
    ):
        with pytest.raises(ValueError, match=f"{re.escape(str(path))}: {message}"):
            open_stream(path, world_frame=name)
    _, pose = open_stream(path, world_frame="base")[0]
    np.testing.assert_allclose(pose, MOUNT, atol=1e-6)


def test_topics_are_chosen_by_name(tmp_path):
    with Bag(tmp_path / "drive", "sqlite3") as bag:
        bag.write_transform(START, "base", "lidar", MOUNT, "/tf_static")
        for time in np.arange(START, START + 1, 0.07):
            bag.write_transform(time, "odom", "base", np.eye(4))  # from bad wheels
            bag.write_odometry(time, "odom", "base", motion(time), "/good")
            bag.write_odometry(time, "odom", "body", motion(time), "/other")
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud, topic="/points")
            bag.write_cloud(stamp, cloud + 1, topic="/raw", recorded=stamp + 0.05)
    with pytest.raises(
        ValueError, match=r"cloud_topic = None, expected one of \['/points', '/raw'\]"
    ):
        open_stream(bag.path)
    with pytest.raises(ValueError, match=r"nothing moves .* topics \['/good', '/other'\] whose"):
        open_stream(bag.path, cloud_topic="/points")
    still = open_stream(bag.path, cloud_topic="/points", world_frame="odom")
    np.testing.assert_allclose(still[0][1], MOUNT, atol=1e-6)
    check_stream(open_stream(bag.path, cloud_topic="/points", odometry_topic="/good"))
    with pytest.raises(ValueError, match=r"odometry_topic = '/bad', expected one of \['/good'"):
        open_stream(bag.path, cloud_topic="/points", odometry_topic="/bad")
    with pytest.raises(ValueError, match=r"/other moves \['body'\], expected one of \['lidar'"):
        open_stream(bag.path, cloud_topic="/points", odometry_topic="/other")


TURNED = np.eye(4)
TURNED[:3, :3] = Rotation.from_rotvec([0, 0, 2.0]).as_matrix()


def write_joint(path, joint, *topics, above=None):
    """A lidar on a joint that is at the pose `joint(time)`, and odometry of (topic, child)."""
    with Bag(path, "mcap") as bag:
        for time in np.arange(START, START + 1, 0.07):
            bag.write_transform(time, "base", "lidar", joint(time))
            if above is not None:
                bag.write_transform(time, "odom", "base", above(time))
            for topic, child in topics:
                bag.write_odometry(time, "odom", child, motion(time), topic)
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud)
    return bag.path


def still(_):
    return MOUNT


def pan(time):
    return MOUNT if time < START + 0.4 else TURNED


@pytest.mark.parametrize("above", [None, still])
def test_transforms_that_do_not_move_the_robot_leave_that_to_odometry(tmp_path, above):
    """Such as from ROS 1's static_transform_publisher, and of a joint under the lidar."""
    wheels = ("/wheels", "base")
    check_stream(open_stream(write_joint(tmp_path / "still", still, wheels, above=above)))
    path = write_joint(tmp_path / "pan", pan, wheels, above=above)
    for i, mount in ((0, MOUNT), (4, TURNED)):
        np.testing.assert_allclose(open_stream(path)[i][1], motion(STAMPS[i]) @ mount, atol=2e-6)
    path = write_joint(tmp_path / "alone", still, above=above)
    with pytest.raises(ValueError, match="nothing moves above the cloud's frame, lidar in base"):
        open_stream(path)


def test_tf_with_the_motion_of_the_robot_takes_precedence(tmp_path):
    def halved(time):
        return motion(START + (time - START) / 2)

    expected = halved(STAMPS[2]) @ MOUNT
    for i, children in enumerate((["base"], ["gps"], ["base", "gps"])):  # gps is in odom, too
        topics = [(f"/{child}", child) for child in children]
        path = write_joint(tmp_path / str(i), still, *topics, above=halved)
        np.testing.assert_allclose(open_stream(path)[2][1], expected, atol=2e-6)


@pytest.mark.parametrize("topics", [[("/vio", "eye")], [("/vio", "base"), ("/wheels", "base")]])
def test_motion_in_tf_or_odometry_is_for_the_caller_to_choose(tmp_path, topics):
    path = write_joint(tmp_path / "drive", pan, *topics)
    with pytest.raises(
        ValueError, match=r"tf moves \['lidar'\], and .*'/vio'.* odometry_topic= or"
    ):
        open_stream(path)
    np.testing.assert_allclose(open_stream(path, world_frame="base")[4][1], TURNED, atol=1e-6)


def test_bags_without_motion_or_clouds(tmp_path):
    path = write_bag(tmp_path / "still", "sqlite3", moving="")
    with pytest.raises(ValueError, match="nothing moves above the cloud's frame, lidar in base"):
        open_stream(path)
    np.testing.assert_allclose(open_stream(path, world_frame="base")[0][1], MOUNT, atol=1e-6)
    path = write_bag(tmp_path / "apart", "ros1", moving="odometry", static=False)
    with pytest.raises(NoPosesError, match="nothing moves above the cloud's frame, lidar"):
        open_stream(path)
    with pytest.raises(
        ValueError, match=r"/odometry moves \['base'\], expected one of \['lidar'\]"
    ):
        open_stream(path, odometry_topic="/odometry")
    path = write_bag(tmp_path / "blind", "ros1", clouds=False)
    with pytest.raises(ValueError, match=r"cloud_topic = None, expected one of \[\]"):
        open_stream(path)


def test_a_sensor_that_stands_still_ignores_the_odometry_of_another_robot(tmp_path):
    with Bag(tmp_path / "hall", "ros1") as bag:
        for time in np.arange(START, START + 1, 0.1):
            bag.write_transform(time, "map", "lidar", MOUNT)
            bag.write_odometry(time, "odom", "base", motion(time))
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud)
    with pytest.raises(NoPosesError, match="or a world_frame if the sensor stands still"):
        open_stream(bag.path)
    np.testing.assert_allclose(open_stream(bag.path, world_frame="map")[0][1], MOUNT, atol=1e-6)


def test_a_world_frame_that_only_tf_has_chooses_tf(tmp_path):
    """Odometry would put another frame above the base."""
    with Bag(tmp_path / "arm", "ros1") as bag:
        for time in np.arange(START, START + 1, 0.05):
            bag.write_transform(time, "base", "lidar", motion(time))
            bag.write_transform(time, "world", "base", MOUNT)
            bag.write_odometry(time, "odom", "base", motion(time))
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud)
    poses = [open_stream(bag.path, world_frame="world")[i][1] for i in (0, 3)]
    expected = [MOUNT @ motion(STAMPS[i]) for i in (0, 3)]
    np.testing.assert_allclose(poses, expected, atol=1e-3)


@pytest.mark.parametrize("moving", ["", "tf", "odometry"])
@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_bags_whose_poses_are_not_read(tmp_path, kind, moving):
    path = write_bag(tmp_path / "drive", kind, moving=moving, static=moving == "tf")
    if moving != "tf":
        with pytest.raises(NoPosesError):
            open_stream(path)
    stream = open_stream(path, poses=False)
    np.testing.assert_allclose(stream.stamps, STAMPS, rtol=1e-15)  # not when they were recorded
    for i in range(5):
        np.testing.assert_array_equal(stream[i][0], CLOUDS[i])
        np.testing.assert_array_equal(stream[i][1], np.eye(4))


def test_clouds_recorded_at_the_same_time(tmp_path):
    with Bag(tmp_path / "drive", "sqlite3") as bag:
        for time in np.arange(START, START + 1, 0.07):
            bag.write_odometry(time, "odom", "lidar", motion(time))
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud, recorded=START + 2)
    stream = open_stream(bag.path)
    for i in range(5):
        np.testing.assert_array_equal(stream[i][0], CLOUDS[i])
        np.testing.assert_allclose(stream[i][1], motion(STAMPS[i]), atol=2e-6)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ("lidar2", "in frame 'lidar2', which has no transform up to the frame of the map, 'odom'"),
        ("odom", "in frame 'odom', which has no transform up to"),
        ("mirror", r"mirror in mast: frame 'odom' is not above 'mirror', expected one of \['mast'"),
        ("rear", None),
    ],
)
def test_later_clouds_in_other_frames(tmp_path, frame, message):
    with Bag(tmp_path / "drive", "mcap") as bag:
        bag.write_transform(START, "base", "lidar", MOUNT, "/tf_static")
        bag.write_transform(START, "base", "rear", TURNED, "/tf_static")
        bag.write_transform(START, "mast", "mirror", MOUNT, "/tf_static")
        for time in np.arange(START, START + 1, 0.07):
            bag.write_transform(time, "odom", "base", motion(time))
        bag.write_cloud(STAMPS[0], CLOUDS[0])
        bag.write_cloud(STAMPS[1], CLOUDS[1], frame)
    stream = open_stream(bag.path)
    np.testing.assert_allclose(stream[0][1], motion(STAMPS[0]) @ MOUNT, atol=2e-6)
    if message is None:
        np.testing.assert_allclose(stream[1][1], motion(STAMPS[1]) @ TURNED, atol=2e-6)
    else:
        with pytest.raises(
            BadFrameError, match=f"frame 1: {re.escape(str(bag.path))}, .*{message}"
        ):
            read_frame(stream, 1)


def test_a_transform_has_one_pose_at_a_time(tmp_path):
    with Bag(tmp_path / "drive", "mcap") as bag:
        bag.write_transform(START, "base", "lidar", MOUNT, "/tf_static")
        for time in np.repeat(np.arange(START, START + 1, 0.07), 2):
            bag.write_transform(time, "odom", "base", motion(time))  # twice the same
            bag.write_transform(START, "base", "wheel", motion(time))  # not on the way up
        bag.write_transform(START, "map", "odom", np.eye(4))
        bag.write_transform(START, "map", "odom", MOUNT)
        for stamp, cloud in zip(STAMPS, CLOUDS, strict=True):
            bag.write_cloud(stamp, cloud)
    with pytest.raises(
        ValueError, match=r"drive, odom in map, at 1700000000\.0+ s: another pose at 1700000000\."
    ):
        open_stream(bag.path)
    check_stream(open_stream(bag.path, world_frame="odom"))


def test_frames_without_a_transform(tmp_path):
    stream = open_stream(write_bag(tmp_path / "drive", "ros1", until=0.4))
    read_frame(stream, 2)
    with pytest.raises(BadFrameError, match=r"frame 4: .*base in odom: no pose for 1700000000\.53"):
        read_frame(stream, 4)
    with pytest.raises(BadFrameError, match=r"^frame 3: "):
        find_bounds(stream)
    assert find_bounds(stream, skip_bad_frames=True).max_range > 2


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_broken_bags(tmp_path, kind):
    path = write_bag(tmp_path / "drive", kind)
    file = path if kind == "ros1" else next(p for p in path.iterdir() if p.suffix != ".yaml")
    content = file.read_bytes()
    for broken in (b"", b"not a bag", content[:300], content[: len(content) // 2]):
        file.write_bytes(broken)
        with pytest.raises(ValueError, match=re.escape(str(path))):
            open_stream(path)


def write_zeros(path, kind, count):
    """A bag whose only cloud has this many returns, all of them zeros, compressed."""
    bag = Bag(path, kind)
    if kind == "ros1":
        bag.writer.set_compression(Writer1.CompressionFormat.BZ2)
    else:
        mode = {"sqlite3": "MESSAGE", "file": "FILE", "mcap": "STORAGE"}[kind]
        mode = CompressionMode[mode]
        bag.writer.set_compression(mode, CompressionFormat.ZSTD)
    with bag:
        for stamp in (START, START + 1):
            bag.write_odometry(stamp, "odom", "lidar", motion(stamp))
        bag.write_cloud(START + 0.5, np.broadcast_to(np.float32(0), (count, 3)))
    return bag.path


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "file", "mcap"])
def test_compressed_bags_inflate_to_a_limit(tmp_path, kind):
    stream = open_stream(write_zeros(tmp_path / "small", kind, 1000))
    assert stream[0][0].shape == (1000, 3)
    path = write_zeros(tmp_path / "many", kind, 2_200_000)  # returns; 50 MB
    with pytest.raises(ValueError, match="2200000 returns, expected at most 2097152"):
        open_stream(path)[0]
    path = write_zeros(tmp_path / "large", kind, 4_000_000)
    tracemalloc.start()
    with pytest.raises(ValueError, match=f"{re.escape(str(path))}: not a readable .*inflate"):
        open_stream(path)[0]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6


def test_number_types_and_padding_of_points():
    def message(points, height=1, row_pad=0, big=False):
        types = {"f4": 7, "f8": 8, "i2": 3}
        fields = [
            SimpleNamespace(name=n, offset=o, datatype=types[d.str[1:]], count=1)
            for n, (d, o) in points.dtype.fields.items()
        ]
        step, width = points.dtype.itemsize, len(points) // height
        rows = points.reshape(height, width)
        data = b"".join(row.tobytes() + bytes(row_pad) for row in rows)
        return SimpleNamespace(
            fields=fields,
            height=height,
            width=width,
            is_bigendian=big,
            point_step=step,
            row_step=width * step + row_pad,
            data=np.frombuffer(data, np.uint8),
        )

    expected = np.arange(18).reshape(6, 3)
    for kind, big in [("<f4", False), ("<f8", False), (">f4", True), ("<i2", False)]:
        points = np.zeros(6, [("z", kind), ("y", kind), ("x", kind)])
        points["x"], points["y"], points["z"] = expected.T
        for height, pad in [(1, 0), (2, 0), (3, 8)]:
            cloud = cloud_of(message(points, height, pad, big))
            assert cloud.dtype == np.float32
            np.testing.assert_array_equal(cloud, expected)
    assert cloud_of(message(points[:0])).shape == (0, 3)
    short = message(points)
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="35 bytes in rows of 36, expected 1 x 6 points of 6"):
        cloud_of(short)
    with pytest.raises(ValueError, match=r"fields are \['x'\], expected x, y and z"):
        cloud_of(message(np.zeros(2, [("x", "<f4")])))
