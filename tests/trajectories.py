"""Recorded motions, made small for tests, as tables and as bags."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from surgbench.geometry import FloatArray
from surgbench.tasks.viewpoint.conformance.worlds import circling

STEPS = 160
# What poses are in tables and messages: position, quaternion x, y, z, w.
HEADER = "time_s,x_m,y_m,z_m,qx,qy,qz,qw"


def numbers(poses: FloatArray) -> FloatArray:
    """``(T, 7)`` position and quaternion of ``(T, 4, 4)`` poses."""
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def feature() -> tuple[FloatArray, FloatArray]:
    """Times and poses of a ring that goes round in a circle, its normal up and to one side."""
    trial = circling(STEPS)
    return trial.timestamps_s, trial.T_world_feature


def put_table(path: Path, times_s: FloatArray, poses: FloatArray, header: str = HEADER) -> Path:
    """A table of poses, exact."""
    rows = [[float(time), *map(float, row)] for time, row in zip(times_s, numbers(poses), strict=True)]
    path.write_text("\n".join([header, *(",".join(map(repr, row)) for row in rows)]) + "\n")
    return path


def put_bag(
    path: Path,
    times_s: FloatArray,
    poses: FloatArray,
    *,
    ros: int,
    topics: tuple[str, ...] = ("/PSM1/measured_cp",),
    kind: str = "PoseStamped",
    storage: str = "SQLITE3",
    frame: str = "PSM1_base",
) -> Path:
    """A bag of ROS 1 or 2 with poses in each of some topics, and one topic of something else."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    types = store.types
    writer: Any = Writer1(path) if ros == 1 else Writer2(path, version=9, storage_plugin=StoragePlugin[storage])

    def encoded(message: Any, name: str) -> bytes:
        data = store.serialize_ros1(message, name) if ros == 1 else store.serialize_cdr(message, name)
        return bytes(data)

    name = f"geometry_msgs/msg/{kind}"
    with writer:
        connections = [writer.add_connection(topic, name, typestore=store) for topic in topics]
        other = writer.add_connection("/PSM1/note", "std_msgs/msg/String", typestore=store)
        for index, (time_s, row) in enumerate(zip(times_s, numbers(poses), strict=True)):
            stamp_ns = 1_700_000_000_000_000_000 + round(1e9 * time_s)
            stamp = types["builtin_interfaces/msg/Time"](sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
            counted = {"seq": index} if ros == 1 else {}
            header = types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame, **counted)
            turn = types["geometry_msgs/msg/Quaternion"](*row[3:])
            if kind == "TransformStamped":
                place = types["geometry_msgs/msg/Vector3"](*row[:3])
                inner = types["geometry_msgs/msg/Transform"](translation=place, rotation=turn)
                message = types[name](header=header, child_frame_id="tool", transform=inner)
            else:
                inner = types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](*row[:3]), turn)
                message = types[name](header=header, pose=inner) if kind == "PoseStamped" else inner
            for connection in connections:
                # Recorded later than it was measured, and unevenly.
                writer.write(connection, stamp_ns + 1_000_000 * (index % 7), encoded(message, name))
        note = types["std_msgs/msg/String"](data="clutch")
        writer.write(other, stamp_ns, encoded(note, "std_msgs/msg/String"))
    return path
