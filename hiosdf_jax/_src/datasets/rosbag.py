"""ROS 1 and ROS 2 bags with PointCloud2 messages and tf or odometry.

The pose of a cloud is the product of the transforms from its frame up to the root of the tf tree,
each interpolated at the stamp of the cloud. If tf does not contain the motion of the robot, an
odometry message is the transform from its `header.frame_id` to its `child_frame_id`. A transform
that is published again and again but never changes, and a joint below the frame that the odometry
moves, are not the motion of the robot. Clouds are used as recorded, with the motion within a sweep
not corrected.

The `rosbags` package reads both kinds of bag without ROS.
"""

from __future__ import annotations

import contextlib
import math
import os
import struct
import weakref
from collections import defaultdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hiosdf_jax._src.datasets.bag_frames import (
    Transform,
    find_tree,
    frame_name,
    unique_path_up,
)
from hiosdf_jax._src.datasets.files import most_returns, open_regular, parsing
from hiosdf_jax._src.datasets.inflating import limit_rosbags
from hiosdf_jax._src.datasets.stream import FrameStream
from hiosdf_jax._src.datasets.transforms import transform_up

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader
    from rosbags.interfaces import Connection

_CLOUD = "sensor_msgs/msg/PointCloud2"
_ODOMETRY = "nav_msgs/msg/Odometry"
_TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField's


def rosbag_stream(
    path: str | os.PathLike[str],
    cloud_topic: str | None = None,
    odometry_topic: str | None = None,
    world_frame: str | None = None,
    *,
    poses: bool = True,
) -> FrameStream:
    """Opens a ROS 1 or ROS 2 bag.

    Args:
        path: A `.bag`, `.mcap` or `.db3` file, or the folder of a ROS 2 bag.
        cloud_topic: Topic of the PointCloud2 messages; needed if there are several.
        odometry_topic: Topic of Odometry messages, which replace tf for their child frame. By
            default odometry is used if there is one topic and tf does not contain its motion.
        world_frame: Frame of the map; by default the root of the tf tree.
        poses: Whether to read tf and odometry. If not, each pose is the identity.

    Returns:
        The clouds as a stream. A cloud without transforms at its time, or in a frame that has
        none, is a bad frame. The bag stays open for the lifetime of the stream.

    Raises:
        FileNotFoundError: There is no such file.
        NoPosesError: The bag does not contain the motion of the sensor.
        ValueError: The bag cannot be read, a topic is missing or ambiguous, tf and odometry may
            both be the motion of the sensor, or a transform has two poses at one time.
        ModuleNotFoundError: rosbags is not installed.

    Example:
        stream = datasets.rosbag_stream("drive", cloud_topic="/points", odometry_topic="/odom")
        cloud, pose = stream[0]
    """
    try:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "ROS bags are read by rosbags: in a clone, pip install '.[ros]'"
        ) from error
    path = Path(path)
    size = 0
    for each in path.iterdir() if path.is_dir() else [path]:
        if not each.is_dir():
            with open_regular(each) as file:
                size += os.fstat(file.fileno()).st_size
    limit_rosbags()
    with parsing(path, "ROS bag"):
        # Older ROS 2 bags do not contain their types; the types read here have not changed.
        reader = AnyReader([path], default_typestore=get_typestore(Stores.LATEST))
        reader.open()
    closing = contextlib.ExitStack()
    closing.callback(reader.close)
    with closing:
        clouds = _clouds(reader, path, cloud_topic)
        with parsing(path, "ROS bag"):
            times, transforms, odometry, first = _scan(reader, clouds)
        if first is None:
            raise ValueError(f"{path}: topic {clouds[0].topic!r} has no message, expected clouds")
        sensor = frame_name(first.header.frame_id)
        edges, above = {}, [sensor]  # without poses nothing is above the sensor
        if poses:
            edges, above = find_tree(
                path, transforms, odometry, sensor, odometry_topic, world_frame
            )
        kept_open = closing.pop_all()

    def frame(index: int) -> tuple[np.ndarray, np.ndarray]:
        start, among, _ = times[index]
        with parsing(f"{path}, {clouds[0].topic} at {start} ns", "PointCloud2"):
            with contextlib.closing(reader.messages(clouds, start=start, stop=start + 1)) as found:
                connection, _, raw = next(m for i, m in enumerate(found) if i == among)
            message: Any = reader.deserialize(raw, connection.msgtype)
            returns, most = int(message.height) * int(message.width), most_returns(size)
            if returns > most:
                raise ValueError(f"{returns} returns, expected at most {most}")
            cloud = cloud_of(message)
        return cloud, transform_up(edges, upward(message), _seconds(message.header.stamp))

    def upward(message: Any) -> list[str]:
        own = frame_name(message.header.frame_id)
        if own == sensor:
            return above
        if own not in edges or own == above[-1]:
            raise ValueError(
                f"{path}, {clouds[0].topic}: cloud in frame {own!r}, which has no transform up to "
                f"the frame of the map, {above[-1]!r}"
            )
        return unique_path_up(edges, own, above[-1])

    stream = FrameStream(path, len(times), frame, [stamp for _, _, stamp in times])
    weakref.finalize(stream, kept_open.close)
    return stream


def cloud_of(message: Any) -> np.ndarray:
    """Converts a PointCloud2 message.

    Args:
        message: The message, with fields x, y and z of any number type.

    Returns:
        (height * width, 3) float32.

    Raises:
        ValueError: A field is missing, or there is too little data.
    """
    fields = {field.name: field for field in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"fields are {list(fields)}, expected x, y and z")
    order = ">" if message.is_bigendian else "<"
    point = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + _TYPES[fields[name].datatype] for name in "xyz"],
            "offsets": [fields[name].offset for name in "xyz"],
            "itemsize": message.point_step,
        }
    )
    height, width = int(message.height), int(message.width)
    if not height * width:
        return np.zeros((0, 3), np.float32)
    needed = (height - 1) * message.row_step + width * message.point_step
    if len(message.data) < needed or message.row_step < width * message.point_step:
        raise ValueError(
            f"{len(message.data)} bytes in rows of {message.row_step}, expected {height} x {width} "
            f"points of {message.point_step}"
        )
    strides = (message.row_step, message.point_step)
    points = np.ndarray((height, width), point, np.ascontiguousarray(message.data), 0, strides)
    return np.stack([points[name].astype(np.float32).ravel() for name in "xyz"], axis=-1)


def _clouds(reader: AnyReader, path: Path, topic: str | None) -> list[Connection]:
    """Returns the connections of the topic with the clouds."""
    topics = sorted({c.topic for c in reader.connections if c.msgtype == _CLOUD})
    if topic is None and len(topics) == 1:
        topic = topics[0]
    if topic not in topics:
        raise ValueError(f"{path}: cloud_topic = {topic!r}, expected one of {topics}")
    return [c for c in reader.connections if c.topic == topic and c.msgtype == _CLOUD]


def _scan(
    reader: AnyReader, clouds: list[Connection]
) -> tuple[list[tuple[int, int, float]], list[Transform], dict[str, list[Transform]], Any]:
    """Reads a bag once, one message at a time.

    Returns:
        For each cloud the time of recording, ns, its rank among the clouds of that time, and its
        stamp, s; the transforms of tf; the transforms of each odometry topic; the first cloud's
        message.
    """
    wanted = [c for c in reader.connections if c.msgtype in (*_TRANSFORMS, _ODOMETRY)]
    times: list[tuple[int, int, float]] = []
    transforms: list[Transform] = []
    odometry: dict[str, list[Transform]] = defaultdict(list)
    first = None
    for connection, time, raw in reader.messages([*clouds, *wanted]):
        if connection.msgtype == _CLOUD:
            again = bool(times) and times[-1][0] == time
            times.append((time, times[-1][1] + 1 if again else 0, _stamp_of(raw, reader.is2)))
            if first is None:
                first = reader.deserialize(raw, connection.msgtype)
            continue
        message: Any = reader.deserialize(raw, connection.msgtype)
        if connection.msgtype == _ODOMETRY:
            pose = message.pose.pose
            row = _seconds(message.header.stamp), pose.position, pose.orientation
            names = frame_name(message.child_frame_id), frame_name(message.header.frame_id)
            odometry[connection.topic].append((*names, False, row))
            continue
        fixed = connection.topic.endswith("tf_static")
        for each in message.transforms:
            row = _seconds(each.header.stamp), each.transform.translation, each.transform.rotation
            names = frame_name(each.child_frame_id), frame_name(each.header.frame_id)
            transforms.append((*names, fixed, row))
    return times, transforms, odometry, first


def _stamp_of(raw: bytes, is_ros2: bool) -> float:
    """Time of a message that begins with a header, s, without the cost of reading the rest of it.

    Four bytes are before the stamp: a count in ROS 1, and in ROS 2 the encoding, whose second byte
    is the order of the bytes.
    """
    if len(raw) < 12:
        return math.nan
    order = ">" if is_ros2 and raw[1] == 0 else "<"
    seconds, nanoseconds = struct.unpack_from(f"{order}II", raw, 4)
    return seconds + 1e-9 * nanoseconds


def _seconds(stamp: Any) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec
