"""What a multi-way method is, and how one is found by name.

A synchronizer is found through the Python entry-point group `nss_ros.synchronizers`; the entry
point is called with a `MultiwayConfig` and returns a `Synchronizer`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol, runtime_checkable

from nss_ros.config import MultiwayConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment, FragmentId
from nss_ros.multiway.pose_graph import Measurement, PoseGraph

ENTRY_POINT_GROUP = "nss_ros.synchronizers"


class Synchronizer(Protocol):
    """A multi-way registration method."""

    name: str

    def synchronize(
        self, fragments: Sequence[FragmentId], measurements: Sequence[Measurement]
    ) -> PoseGraph:
        """Poses of all fragments from the relative transforms between them.

        The result does not depend on the order of the arguments. Every fragment becomes a node
        and every measurement an edge, both in canonical order; fragments that no accepted edge
        links to another are UNPLACED; each connected component has a map frame of its own.
        """
        ...


@runtime_checkable
class PointSynchronizer(Synchronizer, Protocol):
    """A synchronizer that looks at the points, too, once there is time for it.

    While answers still come in, and where no points are at hand, `synchronize` is called.
    """

    def synchronize(
        self,
        fragments: Sequence[FragmentId],
        measurements: Sequence[Measurement],
        known: PoseGraph | None = None,
    ) -> PoseGraph:
        """As that of a `Synchronizer`.

        Args:
            fragments: all of them.
            measurements: between them.
            known: the last result of `synchronize_points`, for some of them, which is better than
                what can be found without points; answers and constraints may be gone since.
        """
        ...

    def prepare(self, fragment: Fragment) -> Any:
        """What it needs of a fragment, made once; None if it cannot use this one."""
        ...

    def synchronize_points(
        self,
        fragments: Sequence[FragmentId],
        measurements: Sequence[Measurement],
        prepared: Mapping[FragmentId, Any],
    ) -> PoseGraph:
        """As `synchronize`, with what `prepare` made of the fragments that it can use."""
        ...


def synchronizer_names() -> list[str]:
    """Names of all installed synchronizers, sorted."""
    return sorted({entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)})


def find_synchronizer(name: str) -> EntryPoint:
    """The entry point of a synchronizer, not loaded.

    Raises:
        MethodError: no such synchronizer is installed.
    """
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return entry
    raise MethodError(
        f"There is no synchronizer '{name}': choose one of {', '.join(synchronizer_names())}."
    )


def load_synchronizer(config: MultiwayConfig) -> Synchronizer:
    """The synchronizer that a configuration names.

    Raises:
        MethodError: no such synchronizer is installed.
    """
    synchronizer: Synchronizer = find_synchronizer(config.synchronizer).load()(config)
    return synchronizer
