"""What a registration method is, and how one is found by name.

A method is found through the Python entry-point group `nss_ros.registration_methods`, so a
package of your own adds one without touching this code:

    [project.entry-points."nss_ros.registration_methods"]
    my_method = "my_package:MyMethod"

The entry point is called with a `RegistrationConfig` and returns a `Method`.
"""

from __future__ import annotations

from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

from nss_ros.config import RegistrationConfig
from nss_ros.errors import MethodError
from nss_ros.fragment import Fragment
from nss_ros.registration.relative_transform import RelativeTransform

ENTRY_POINT_GROUP = "nss_ros.registration_methods"


class Method(Protocol):
    """A pairwise registration method. Instances are used by one thread at a time."""

    name: str

    def prepare(self, fragment: Fragment) -> Any:
        """Features of one fragment: picklable, computed once, reused for all its pairs.

        The origin of a levelled fragment is where its scanner stood: see `nss_ros.standpoint`.
        """
        ...

    def register(self, source: Any, target: Any, seed: int) -> RelativeTransform:
        """`T_target_source` of two prepared fragments; the same seed gives the same result."""
        ...


def method_names() -> list[str]:
    """Names of all installed methods, sorted."""
    return sorted({entry.name for entry in entry_points(group=ENTRY_POINT_GROUP)})


def find_method(name: str) -> EntryPoint:
    """The entry point of a registration method, not loaded.

    Raises:
        MethodError: no such method is installed.
    """
    for entry in entry_points(group=ENTRY_POINT_GROUP):
        if entry.name == name:
            return entry
    raise MethodError(
        f"There is no registration method '{name}': choose one of {', '.join(method_names())}."
    )


def load_method(config: RegistrationConfig) -> Method:
    """The method that a configuration names.

    Raises:
        MethodError: no such method is installed, or it lacks something that it needs.
    """
    method: Method = find_method(config.method).load()(config)
    return method
