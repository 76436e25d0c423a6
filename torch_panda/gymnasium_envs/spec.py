"""Gymnasium's specification of an environment, whose options survive as JSON.

Minari stores the specification of an environment as JSON, from which
``recover_environment()`` makes the environment again.
"""

import copy
import dataclasses
from collections.abc import Mapping
from enum import Enum
from typing import Any

import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from torch import Tensor

from torch_panda.bullet import PhysicsParams
from torch_panda.envs.randomization import Randomization
from torch_panda.rendering import Camera, HandCamera
from torch_panda.sensors import Sensor

# Classes of the options that JSON holds as mappings. `read_json` tells the two classes
# of cameras apart by their fields.
_CLASSES = (Camera, HandCamera, PhysicsParams, Randomization)
_CAMERAS = ("camera", "render_camera")


class SpecAttribute:
    """Attribute ``spec`` of an environment, which Gymnasium sets; makes it a `Spec`."""

    def __get__(self, env: object | None, owner: type | None = None) -> EnvSpec | None:
        return None if env is None else vars(env).get("spec")

    def __set__(self, env: object, spec: EnvSpec | None) -> None:
        if spec is not None:
            values = {x.name: getattr(spec, x.name) for x in dataclasses.fields(spec)}
            for name in ("namespace", "name", "version"):  # computed from the id
                values.pop(name)
            spec = Spec(**values)
        vars(env)["spec"] = spec


class Spec(EnvSpec):
    """Specification of an environment. `read_json` reads what `to_json` writes."""

    def to_json(self) -> str:
        """Convert the specification to JSON, for ``EnvSpec.from_json``.

        Raises:
            ValueError: An option cannot be written as JSON.
        """
        plain = copy.copy(self)
        plain.kwargs = {
            name: _to_plain(f"{name} of {self.id}", value)
            for name, value in self.kwargs.items()
        }
        return super(Spec, plain).to_json()

    def __eq__(self, other: object) -> bool:
        """Whether another specification, also a plain ``EnvSpec``, has equal fields."""
        return isinstance(other, EnvSpec) and all(
            getattr(self, field.name) == getattr(other, field.name)
            for field in dataclasses.fields(self)
        )

    __hash__ = None  # type: ignore[assignment]  # it can be changed, as an EnvSpec can


def read_json(options: Mapping[str, Any]) -> dict[str, Any]:
    """Make the objects of options that JSON holds as mappings.

    Args:
        options: Arguments of a Gymnasium environment, such as the ``kwargs`` of an
            ``EnvSpec`` that was read from JSON.

    Raises:
        TypeError: A mapping has an unknown entry.
        ValueError: An entry is out of range.
    """
    read = dict(options)
    for name, value in options.items():
        if isinstance(value, Mapping) and name in (*_CAMERAS, "physics", "randomize"):
            cls: Any = {"physics": PhysicsParams, "randomize": Randomization}.get(name)
            if name in _CAMERAS:
                cls = HandCamera if "eye" in value else Camera
            read[name] = cls(**{key: _to_tuple(entry) for key, entry in value.items()})
    return read


def _to_tuple(value: Any) -> Any:  # noqa: ANN401 (any JSON value)
    return tuple(value) if isinstance(value, list) else value


def _to_plain(name: str, value: Any) -> Any:  # noqa: ANN401 (any option)
    """Convert an option to the types that JSON has.

    Args:
        name: Name of the option, for the error.
        value: The option.

    Raises:
        ValueError: JSON cannot hold the value.
    """
    if isinstance(value, np.generic | np.ndarray | Tensor):
        return value.tolist()
    if isinstance(value, torch.device):
        return str(value)
    if isinstance(value, Enum):
        return value.value
    if type(value) in _CLASSES:
        value = {x.name: getattr(value, x.name) for x in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: _to_plain(name, entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_to_plain(name, entry) for entry in value]
    if value is None or isinstance(value, str | int | float):
        return value
    hint = ""
    if isinstance(value, Sensor):
        hint = (
            ": give sensors by name, such as sensors=('joint_state',), and a camera by "
            "from_pixels, depth or segmentation"
        )
    raise ValueError(f"{name} cannot be written as JSON, got {value!r}{hint}")
