"""ROS message definitions without ROS: the Jazzy type store with nss_msgs added."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore


@cache
def jazzy_typestore() -> Typestore:
    """Jazzy's standard messages and ours, read from the `.msg` files of nss_msgs."""
    store = get_typestore(Stores.ROS2_JAZZY)
    types = {}
    for path in sorted(files("nss_ros").joinpath("interfaces").iterdir(), key=lambda p: p.name):
        if path.name.endswith(".msg"):
            name = f"nss_msgs/msg/{path.name.removesuffix('.msg')}"
            types.update(get_types_from_msg(path.read_text(), name))
    store.register(types)
    return store
