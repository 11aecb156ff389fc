"""One answer to one pair, whatever happens."""

from __future__ import annotations

from dataclasses import replace
from time import perf_counter
from typing import Any

from nss_ros.config import RegistrationConfig
from nss_ros.errors import NssError
from nss_ros.fragment import FragmentPair
from nss_ros.registration.method import Method
from nss_ros.registration.relative_transform import Reason, RelativeTransform, failed
from nss_ros.registration.seed import pair_seed


def register_pair(
    method: Method,
    source: Any | None,
    target: Any | None,
    pair: FragmentPair,
    config: RegistrationConfig,
) -> RelativeTransform:
    """Register a pair of prepared fragments; never raises.

    Args:
        method: the registration method.
        source: its features of the source, None when the fragment is unknown.
        target: its features of the target, None when the fragment is unknown.
        pair: what was asked; its hash is mixed into the seed.
        config: settings of registration.

    Returns:
        The estimate, or a failure with its reason, with the seconds spent.
    """
    start = perf_counter()
    unknown = [
        str(fragment)
        for fragment, features in ((pair.source, source), (pair.target, target))
        if features is None
    ]
    if unknown:
        message = f"{' and '.join(unknown)} was never published."
        answer = failed(pair, method.name, Reason.UNKNOWN_FRAGMENT, message)
    else:
        answer = _registered(method, source, target, pair, config)
    return replace(answer, pair=pair, compute_time=perf_counter() - start)


def _registered(
    method: Method, source: Any, target: Any, pair: FragmentPair, config: RegistrationConfig
) -> RelativeTransform:
    try:
        return method.register(source, target, pair_seed(pair, config.seed))
    except NssError as error:
        return failed(pair, method.name, Reason.METHOD_ERROR, str(error))
    except Exception as error:  # a plug-in may raise anything, and a pair needs one answer
        message = f"{type(error).__name__}: {error}"
        return failed(pair, method.name, Reason.METHOD_ERROR, message)
