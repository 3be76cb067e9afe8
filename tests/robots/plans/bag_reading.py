"""Messages in a bag, as a reader without falsework sees them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest


def messages(path: Path, *topics: str) -> list[tuple[str, int, Any]]:
    """Topic, nanoseconds and content of each message of a bag, in the order of their times; of some topics or all."""
    reader = pytest.importorskip("mcap.reader", reason="bags need mcap; pip install 'falsework[schedule]'")
    typesys = pytest.importorskip("rosbags.typesys", reason="bags need rosbags; pip install 'falsework[schedule]'")
    store, known, found = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), set(), []
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages(topics=topics or None):
            if schema.name not in known:
                known.add(schema.name)
                defined = typesys.get_types_from_msg(schema.data.decode(), schema.name)
                store.register({name: fields for name, fields in defined.items() if name not in store.types})
            found.append((channel.topic, message.log_time, store.deserialize_cdr(message.data, schema.name)))
    return found


def planning_scenes(path: Path) -> list[tuple[int, Any]]:
    """The planning scenes of a bag with their times in nanoseconds."""
    return [(time, scene) for _, time, scene in messages(path, "/planning_scene")]


def corners(thing: Any) -> np.ndarray:
    """The vertices of the only mesh of a collision object, shape (vertices, 3)."""
    (mesh,) = thing.meshes
    return np.array([(point.x, point.y, point.z) for point in mesh.vertices])


def wrenches(path: Path, topic: str) -> list[tuple[int, Any]]:
    """The wrenches on a topic of a bag with their times in nanoseconds."""
    found = messages(path, topic)
    assert {message.__msgtype__ for _, _, message in found} == {"geometry_msgs/msg/WrenchStamped"}
    return [(time, message) for _, time, message in found]
