"""Poses of a topic in a bag of ROS 1 or ROS 2. Needs rosbags, of the extra ``bags``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from surgbench.errors import ConfigError, DatasetError, SurgbenchError, unknown_name
from surgbench.extras import missing
from surgbench.recordings.poses import RawPoses

BAG_SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
# CRTK's name of where an arm's tool is, in its base's frame.
MEASURED = "measured_cp"
# Messages that hold a pose, to where in them it is.
_POSES: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "geometry_msgs/msg/PoseStamped": lambda message: (message.pose.position, message.pose.orientation),
    "geometry_msgs/msg/TransformStamped": lambda message: (message.transform.translation, message.transform.rotation),
    "geometry_msgs/msg/Pose": lambda message: (message.position, message.orientation),
    "geometry_msgs/msg/Transform": lambda message: (message.translation, message.rotation),
}
REPORT_EVERY = 1_000


def is_bag(path: Path) -> bool:
    """Whether a file or folder is a bag, by its name or what lies in it."""
    return path.suffix.lower() in BAG_SUFFIXES or (path / METADATA).is_file()


def count_messages(path: Path, topic: str | None) -> int:
    """How many poses a bag holds; errors as :func:`read_pose_bag`'s."""
    with _opened(path) as reader:
        return int(reader.topics[_topic(path, reader, topic)].msgcount)


def read_pose_bag(
    path: Path, *, topic: str | None = None, progress: Callable[[float], None] = lambda messages: None
) -> tuple[RawPoses, str]:
    """Read the poses of one topic, one message at a time; positions are in metres, times in seconds.

    Args:
        path: ``.bag``, a folder with ``metadata.yaml``, or a ``.db3`` or ``.mcap`` file.
        topic: Its name; the only one that ends in ``measured_cp`` unless told.
        progress: Takes the number of messages just read.

    Returns:
        The poses, and the frame that the messages say they are in; empty where they say none.

    Raises:
        DatasetError: The bag is damaged, or has no such topic; one line.
        ConfigError: Which topic must be told, or the topic holds no poses.
    """
    with _opened(path) as reader:
        name = _topic(path, reader, topic)
        raw = RawPoses(f"{path}, {name}", "message", unit="m", time_unit="s")
        connections = [connection for connection in reader.connections if connection.topic == name]
        frame, stamped, first = "", True, 0
        for number, (connection, received_ns, data) in enumerate(reader.messages(connections=connections), start=1):
            message = reader.deserialize(data, connection.msgtype)
            position, turn = _POSES[connection.msgtype](message)
            header = getattr(message, "header", None)
            sent_ns = 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec
            if number == 1:
                frame, stamped = "" if header is None else str(header.frame_id), sent_ns > 0
                first = sent_ns if stamped else received_ns
                if not stamped:
                    raw.lines.append("messages have no time of their own; taken is when they were recorded")
            # Since the first: nanoseconds since 1970 are more than a float holds.
            since_s = ((sent_ns if stamped else received_ns) - first) / 1e9
            raw.append(number, [since_s, position.x, position.y, position.z, turn.x, turn.y, turn.z, turn.w])
            if number % REPORT_EVERY == 0:
                progress(REPORT_EVERY)
        progress(len(raw.numbers) % REPORT_EVERY)
    return raw, frame


def _topic(path: Path, reader: Any, told: str | None) -> str:
    topics: dict[str, str] = {name: str(info.msgtype) for name, info in reader.topics.items()}
    poses = [name for name, kind in topics.items() if kind in _POSES]
    if told is not None:
        if told not in topics:
            raise DatasetError(f"{path}: --topic: {unknown_name('topic', told, poses or topics)}")
        if told not in poses:
            raise ConfigError(f"{path}: --topic {told}: holds {topics[told]}, no poses ({', '.join(_POSES)})")
        return told
    measured = [name for name in poses if name.rstrip("/").endswith(MEASURED)]
    if len(measured) != 1:
        found = f"{len(measured)} topics end in '{MEASURED}'" if measured else f"no topic ends in '{MEASURED}'"
        choice = ", ".join(measured or poses) or "none"
        raise ConfigError(f"{path}: {found}; --topic says which holds the poses (those that could: {choice})")
    return measured[0]


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """A bag's reader; whatever it trips over in a damaged file is one line."""
    problem = missing(["rosbags"])
    if problem is not None:
        raise ConfigError(f"{path}: is a bag, and {problem}")
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    # A file of a recording that has its metadata beside it is that recording.
    whole = path.parent if path.suffix != ".bag" and (path.parent / METADATA).is_file() else path
    try:
        with AnyReader([whole], default_typestore=get_typestore(Stores.LATEST)) as reader:
            yield reader
    except SurgbenchError:
        raise
    except Exception as error:  # of three formats and their compressions, each with errors of its own
        words = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{path}: cannot be read as a bag, truncated or damaged ({words[:200]})") from None
