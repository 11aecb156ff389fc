"""Scans of a small furnished room."""

import pytest
from furnished_room import room

from nss_ros.fragment import Fragment, FragmentId


@pytest.fixture(scope="session")
def scans():
    """Two scans of the room with different noise and 3/4 of it each, levelled, in one frame."""
    one, other = room(1), room(2)
    return (
        Fragment(FragmentId("1", 1, 0), one[one[:, 0] < 1.3], True),
        Fragment(FragmentId("1", 1, 1), other[other[:, 0] > -1.3], True),
    )
