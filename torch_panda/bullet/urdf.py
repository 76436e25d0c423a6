"""URDF files: where they are, what they must not say, and a link that they lack."""

import functools
import importlib.util
import tempfile
import threading
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import NamedTuple

_SCRATCH_LOCK = threading.Lock()


class Tool(NamedTuple):
    """A massless link that a robot's URDF lacks: the point between its fingers, say.

    Attributes:
        link: the name of the link that it is fixed to.
        position: in the frame of that link [m].
    """

    link: str
    position: tuple[float, float, float]


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


def find_mesh(name: str, urdf: Path) -> Path | None:
    """A mesh of a URDF, looked for where Bullet does: in all folders above it."""
    name = name.removeprefix("package://").removeprefix("file://")
    candidates = [parent / name for parent in urdf.parents]
    return next((path for path in candidates if path.is_file()), None)


@functools.cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="torch_panda-")


def make_scratch_folder() -> Path:
    """A new folder, for URDFs and what they need, that lives until the process ends."""
    # Without it each of several threads would make a directory, of which the cache
    # keeps one: the others are removed at once.
    with _SCRATCH_LOCK:
        return Path(tempfile.mkdtemp(dir=_scratch().name))


@functools.cache
def urdf_with_tool(file: str, tool: Tool) -> str:
    """A URDF file with one more link, the last one, named "tool".

    Raises:
        ValueError: there is no link for it to be fixed to.
    """
    source = Path(file).absolute()
    tree = ElementTree.parse(source)
    robot = tree.getroot()
    links = [link.get("name") for link in robot.findall("link")]
    if tool.link not in links:
        raise ValueError(f"a tool must be fixed to one of {links}, got {tool.link!r}")
    for mesh in tree.iter("mesh"):
        if (found := find_mesh(mesh.get("filename", ""), source)) is not None:
            mesh.set("filename", str(found))
    # A link without this would weigh 1 kg, Bullet's default.
    nothing = (
        "<mass value='0'/><inertia ixx='0' iyy='0' izz='0' ixy='0' ixz='0' iyz='0'/>"
    )
    link = f"<link name='tool'><inertial>{nothing}</inertial></link>"
    robot.append(ElementTree.fromstring(link))
    x, y, z = tool.position
    robot.append(
        ElementTree.fromstring(
            f"<joint name='tool' type='fixed'><parent link='{tool.link}'/>"
            f"<child link='tool'/><origin xyz='{x} {y} {z}'/></joint>"
        )
    )
    path = make_scratch_folder() / source.name
    tree.write(path)
    return str(path)
