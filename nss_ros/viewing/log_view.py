"""A recorded log as a scene."""

from __future__ import annotations

from nss_ros.bag import Log
from nss_ros.errors import InputError
from nss_ros.viewing.scene import Scene


def draw_log(scene: Scene, log: Log) -> None:
    """Draw all that a log holds: the map, its graph, the answers.

    Raises:
        InputError: the log holds neither answers nor a map.
    """
    if log.pose_graph is None and not log.relative_transforms:
        raise InputError(
            f"{log.path} holds neither answers nor a map: view the log that 'nss map' or "
            "'nss benchmark' wrote."
        )
    scene.describe(log.metadata)
    scene.add_answers(list(log.relative_transforms.values()))
    if log.pose_graph is not None:
        scene.draw_graph(log.pose_graph, log.relative_transforms)
        scene.draw_map(log.pose_graph, log.fragments)
