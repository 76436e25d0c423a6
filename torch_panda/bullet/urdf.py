"""URDF files: where they are, and what they must not say."""

import importlib.util
import xml.etree.ElementTree as ElementTree
from pathlib import Path


def find_urdf(path: str | Path) -> str:
    """A URDF file by its path, or by its place among those pybullet ships.

    Raises:
        FileNotFoundError: there is no such file in either place.
    """
    spec = importlib.util.find_spec("pybullet_data")
    assert spec is not None and spec.origin is not None  # part of pybullet's wheel
    shipped = Path(spec.origin).parent
    for candidate in (Path(path), shipped / path):
        if candidate.is_file():
            return str(candidate)
    raise FileNotFoundError(f"no URDF file at {path}, nor at {shipped / path}")


def check_collision_filters(file: str) -> None:
    """Raise ValueError if a URDF chooses its own collision groups or masks."""
    try:
        tree = ElementTree.parse(file)
    except ElementTree.ParseError:
        return  # Bullet says what is wrong
    for shape in tree.iter("collision"):
        chosen = {"group", "mask"} & set(shape.attrib)
        if chosen:
            raise ValueError(
                f"the collision shapes of a URDF must not have a group or a mask, "
                f"got {sorted(chosen)} in {file}"
            )
