"""ROS parameters from the settings of `nss_ros.config`, declared and validated live."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, TypeVar, get_args, get_origin

from pydantic.fields import FieldInfo
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidParameterTypeException,
    InvalidParameterValueException,
    ParameterUninitializedException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from nss_ros.config import Section, validated
from nss_ros.errors import ConfigError, NssError

T = TypeVar("T", bound=Section)

_SIGNS = {"ge": "at least", "gt": "more than", "le": "at most"}


def declare_parameters(node: Node, model: type[T]) -> T:
    """Declare every setting of a section as a parameter and return the values given.

    Raises:
        ConfigError: a value given on the command line or in a file is not valid.
    """
    for name, field in _fields(model):
        try:
            node.declare_parameter(name, _default(field), _descriptor(field))
        except (
            InvalidParameterTypeException,
            InvalidParameterValueException,
            ParameterUninitializedException,
        ) as error:
            raise ConfigError(f"Parameter '{name}' of {node.get_name()}: {error}.") from error
    return _values(node, model, {})


def follow_parameters(
    node: Node,
    model: type[T],
    apply: Callable[[T], None],
    check: Callable[[T], object] = lambda _: None,
) -> None:
    """Check every later change against the section, and hand the section over when it fits.

    Args:
        node: whose parameters.
        model: the section that was declared.
        apply: takes the new settings.
        check: raises an NssError for settings that the section allows but the node cannot use.
    """

    def accept(changes: list[Parameter]) -> SetParametersResult:
        try:
            check(_values(node, model, {change.name: change.value for change in changes}))
        except NssError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def hand_over(_: list[Parameter]) -> None:
        apply(_values(node, model, {}))

    node.add_on_set_parameters_callback(accept)
    node.add_post_set_parameters_callback(hand_over)


def ros_parameters(config: Section) -> dict[str, Any]:
    """A section as nested ROS parameters for a parameter file; empty lists have no type there."""
    return {
        name: ros_parameters(value) if isinstance(value, Section) else value
        for name in type(config).model_fields
        if (value := getattr(config, name)) != []
    }


def _values(node: Node, model: type[T], changes: dict[str, Any]) -> T:
    data: dict[str, Any] = {}
    for name, _ in _fields(model):
        value = changes[name] if name in changes else node.get_parameter(name).value
        *sections, leaf = name.split(".")
        place = data
        for section in sections:
            place = place.setdefault(section, {})
        # An empty list has no type in ROS: such a parameter is not set.
        place[leaf] = [] if value is None else value
    return validated(model, data, f"the parameters of {node.get_name()}")


def _fields(model: type[Section], prefix: str = "") -> Iterator[tuple[str, FieldInfo]]:
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from _fields(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field


def _default(field: FieldInfo) -> Any:
    return field.default if field.default != [] else None


def _descriptor(field: FieldInfo) -> ParameterDescriptor:
    limits = {key: value for item in field.metadata for key, value in _limits(item)}
    descriptor = ParameterDescriptor(description=field.description or "")
    if get_origin(field.annotation) is Literal:
        descriptor.additional_constraints = f"one of: {', '.join(get_args(field.annotation))}"
    elif limits.keys() == {"ge", "le"}:
        _set_range(descriptor, field.annotation, limits["ge"], limits["le"])
    elif limits:
        # One-sided limits have no place in a ROS range; they are checked all the same.
        descriptor.additional_constraints = " and ".join(
            f"{_SIGNS[key]} {value:g}" for key, value in limits.items()
        )
    # Whole numbers are meant as floats: -p rate:=2 must not be a type error.
    descriptor.dynamic_typing = field.annotation is float or field.default == []
    return descriptor


def _set_range(descriptor: ParameterDescriptor, kind: Any, low: float, high: float) -> None:
    if kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high), step=0)]
    else:
        descriptor.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high), step=0.0)
        ]


def _limits(item: Any) -> Iterator[tuple[str, float]]:
    for key in ("ge", "gt", "le"):
        value = getattr(item, key, None)
        if value is not None:
            yield key, value
