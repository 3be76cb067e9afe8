"""Planning scenes in a bag, as a reader without falsework sees them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest


def planning_scenes(path: Path) -> list[tuple[int, Any]]:
    """The planning scenes of a bag with their times in nanoseconds."""
    reader = pytest.importorskip("mcap.reader", reason="bags need mcap; pip install 'falsework[schedule]'")
    typesys = pytest.importorskip("rosbags.typesys", reason="bags need rosbags; pip install 'falsework[schedule]'")
    store, scenes = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE), []
    with path.open("rb") as file:
        for schema, _, message in reader.make_reader(file).iter_messages(topics=["/planning_scene"]):
            if not scenes:
                store.register(typesys.get_types_from_msg(schema.data.decode(), schema.name))
            scenes.append((message.log_time, store.deserialize_cdr(message.data, schema.name)))
    return scenes


def corners(thing: Any) -> np.ndarray:
    """The vertices of the only mesh of a collision object, shape (vertices, 3)."""
    (mesh,) = thing.meshes
    return np.array([(point.x, point.y, point.z) for point in mesh.vertices])


def wrenches(path: Path, topic: str) -> list[tuple[int, Any]]:
    """The wrenches on a topic of a bag with their times in nanoseconds."""
    reader = pytest.importorskip("mcap.reader", reason="bags need mcap; pip install 'falsework[schedule]'")
    typesys = pytest.importorskip("rosbags.typesys", reason="bags need rosbags; pip install 'falsework[schedule]'")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    with path.open("rb") as file:
        found = list(reader.make_reader(file).iter_messages(topics=[topic]))
    assert {schema.name for schema, _, _ in found} == {"geometry_msgs/msg/WrenchStamped"}
    return [(message.log_time, store.deserialize_cdr(message.data, schema.name)) for schema, _, message in found]
