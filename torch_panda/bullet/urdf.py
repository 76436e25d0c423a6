"""URDF files: finding them, checking them, and adding a link to them."""

import functools
import re
import tempfile
import threading
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Concatenate, NamedTuple, ParamSpec, TypeVar

from torch_panda.bullet.library import library_path
from torch_panda.checks import check_vector

_Args = ParamSpec("_Args")
_Result = TypeVar("_Result")

_JOINT_TYPES = (
    "revolute",
    "continuous",
    "prismatic",
    "fixed",
    "floating",
    "planar",
    "spherical",
)
# Geometries that Bullet knows, and the attributes that each of them needs.
_GEOMETRY_ATTRIBUTES = {
    "box": ("size",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "plane": ("normal",),
    "mesh": ("filename",),
    "cdf": ("filename",),
}

_FOLDER_LOCK = threading.Lock()


class Tool(NamedTuple):
    """A massless link to add to a URDF, for example the point between two fingers.

    Attributes:
        link: Name of the link to which the tool is fixed.
        position: Position in the frame of that link [m].
    """

    link: str
    position: tuple[float, float, float]


def find_urdf(path: str | Path) -> str:
    """Absolute path of a URDF file.

    Args:
        path: Path of the file, or its path among the files that pybullet ships.

    Raises:
        FileNotFoundError: The file is in neither place.
    """
    shipped = Path(library_path("pybullet_data")).parent
    for candidate in (Path(path), shipped / path):
        if candidate.is_file():
            return str(candidate.absolute())
    raise FileNotFoundError(f"no URDF file at {path}, nor at {shipped / path}")


def parse_urdf(file: str | Path) -> ElementTree.Element:
    """Read the ``<robot>`` element of a URDF.

    Text before and after the element is ignored, as by Bullet's own parser.

    Raises:
        ValueError: The file has no <robot> element, or is not XML.
    """
    text = Path(file).read_text(errors="replace")
    first, end = re.search(r"<robot\b", text), "</robot>"
    if first is None:
        raise ValueError(f"{file} is not a URDF: it has no <robot> element")
    last = text.rfind(end) + len(end) if end in text else None
    try:
        # Replace each line before the element by an empty line, so that errors have the
        # line numbers of the file.
        empty_lines = "\n" * text.count("\n", 0, first.start())
        return ElementTree.fromstring(empty_lines + text[first.start() : last])
    except ElementTree.ParseError as error:
        raise ValueError(f"{file} is not XML: {error}") from None


def check_urdf(file: str) -> None:
    """Make sure that Bullet can load a URDF.

    Bullet itself crashes if the links do not form one tree. Other faults make it refuse
    the file with a status code that does not name the fault.

    Raises:
        ValueError: Bullet would crash or refuse the file, or the file sets collision
            groups. The error names the file and the element.
    """
    robot = parse_urdf(file)
    for tag in ("link", "joint"):
        _check_names(file, robot, tag)
    _check_tree(file, robot)
    for link in robot.findall("link"):
        for inertial in link.findall("inertial"):
            owner = f"{file}: the <inertial> of link {link.get('name')!r}"
            for tag in ("mass", "inertia"):
                if inertial.find(tag) is None:
                    raise ValueError(f"{owner} has no <{tag}>")
        for shape in (*link.findall("visual"), *link.findall("collision")):
            _check_shape(file, link, shape)


def _check_names(file: str, robot: ElementTree.Element, tag: str) -> None:
    names = set()
    for element in robot.findall(tag):
        name = element.get("name")
        if not name:
            raise ValueError(f"{file}: a <{tag}> has no name")
        if name in names:
            raise ValueError(
                f"{file}: two {tag}s have the name {name!r}, which must be unique"
            )
        names.add(name)


def _check_tree(file: str, robot: ElementTree.Element) -> None:
    """Make sure that the joints attach all links to one base, without loops."""
    links = [str(link.get("name")) for link in robot.findall("link")]
    if not links:
        raise ValueError(f"{file}: a URDF needs at least one <link>")
    parents: dict[str, str] = {}
    for joint in robot.findall("joint"):
        parent, child = _read_joint(file, joint, links)
        if child in parents:
            raise ValueError(
                f"{file}: link {child!r} is the child of two joints, the second is "
                f"{joint.get('name')!r}; a link has one parent"
            )
        parents[child] = parent
    for link in links:
        ancestors = [link]
        while (parent := parents.get(ancestors[-1], "")) in links:
            if parent in ancestors:
                raise ValueError(f"{file}: joints form a loop through link {link!r}")
            ancestors.append(parent)
    base, *detached = (link for link in links if link not in parents)
    if detached:
        raise ValueError(
            f"{file}: no joint attaches link {detached[0]!r} to the base {base!r}: add "
            f"a joint whose child is {detached[0]!r}, or remove the link"
        )


def _read_joint(
    file: str, joint: ElementTree.Element, links: list[str]
) -> tuple[str, str]:
    """Names of a joint's parent and child link. Raise if Bullet could not build it."""
    owner = f"{file}: joint {joint.get('name')!r}"
    joint_type = joint.get("type")
    if joint_type not in _JOINT_TYPES:
        raise ValueError(
            f"{owner} must have one of the types {_JOINT_TYPES}, got {joint_type!r}"
        )
    if joint_type in ("revolute", "prismatic") and joint.find("limit") is None:
        raise ValueError(f"{owner} is {joint_type} and needs a <limit>")
    ends = []
    for tag in ("parent", "child"):
        element = joint.find(tag)
        link = None if element is None else element.get("link")
        if link not in links:
            raise ValueError(
                f"{owner} must have a link of the file as its {tag}, got {link!r}"
            )
        ends.append(str(link))
    return ends[0], ends[1]


def _check_shape(
    file: str, link: ElementTree.Element, shape: ElementTree.Element
) -> None:
    owner = f"{file}: a <{shape.tag}> of link {link.get('name')!r}"
    filters = sorted({"group", "mask"} & set(shape.attrib))
    if filters:
        raise ValueError(
            f"{owner} must not set {filters}: Bullet does not report collision groups "
            f"and masks, so a reset could not restore them"
        )
    geometry = shape.find("geometry/*")
    if geometry is None or geometry.tag not in _GEOMETRY_ATTRIBUTES:
        actual = "nothing" if geometry is None else f"<{geometry.tag}>"
        raise ValueError(
            f"{owner} must have one of {sorted(_GEOMETRY_ATTRIBUTES)} as its geometry, "
            f"got {actual}"
        )
    for attribute in _GEOMETRY_ATTRIBUTES[geometry.tag]:
        if geometry.get(attribute) is None:
            raise ValueError(f"{owner} has a <{geometry.tag}> without {attribute!r}")
    mesh = geometry.get("filename", "")
    if geometry.tag == "mesh" and find_mesh(mesh, Path(file)) is None:
        raise ValueError(
            f"{owner} has the mesh {mesh!r}, which does not exist. Without its prefix, "
            f"such as package://, the name must be a path from the folder of the URDF "
            f"or from a folder above it"
        )


def find_mesh(name: str, urdf: Path) -> Path | None:
    """Find the file of a mesh as Bullet does; None if there is no such file.

    Bullet searches the folder of the URDF, all folders above it, the working directory
    and the two folders above the working directory.

    Args:
        name: Name of the mesh in the URDF, with or without a prefix such as
            ``package://``.
        urdf: Path of the URDF.
    """
    for prefix in ("package://", "model://", "file://"):
        name = name.removeprefix(prefix)
    folders = (*urdf.absolute().parents, Path(), Path(".."), Path("../.."))
    candidates = (folder / name for folder in folders)
    return next((path.absolute() for path in candidates if path.is_file()), None)


@functools.cache
def _process_folder() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="torch_panda-")


def make_scratch_folder() -> Path:
    """Make a new folder for URDFs and meshes; it is deleted when the process ends."""
    # Without the lock, two threads could both make a folder of the process. The cache
    # keeps only one of the two, and Python would delete the other at once.
    with _FOLDER_LOCK:
        return Path(tempfile.mkdtemp(dir=_process_folder().name))


def cache_by_file(
    function: Callable[Concatenate[str, _Args], _Result],
) -> Callable[Concatenate[str, _Args], _Result]:
    """Cache the results of a function of a file until the file changes."""

    @functools.cache
    def call(
        modified: int, file: str, *args: _Args.args, **kwargs: _Args.kwargs
    ) -> _Result:
        return function(file, *args, **kwargs)

    @functools.wraps(function)
    def cached(file: str, *args: _Args.args, **kwargs: _Args.kwargs) -> _Result:
        modified = Path(file).stat().st_mtime_ns
        return call(modified, file, *args, **kwargs)  # type: ignore[arg-type]

    return cached


@cache_by_file
def urdf_with_tool(file: str, tool: Tool) -> str:
    """Write a copy of a URDF with a tool, and return the path of the copy.

    The tool is named "tool" and is the last link in the file. Its index in Bullet may
    be another one, because Bullet's order is depth-first.

    Raises:
        ValueError: The URDF has no link of the name to which the tool is fixed, or
            already has a link or joint named "tool"; or the tool's position is not
            finite.
    """
    source = Path(file).absolute()
    robot = parse_urdf(source)
    links = [link.get("name") for link in robot.findall("link")]
    if tool.link not in links:
        raise ValueError(f"a tool must be fixed to one of {links}, got {tool.link!r}")
    for element in (*robot.findall("link"), *robot.findall("joint")):
        if element.get("name") == "tool":
            raise ValueError(
                f"{file} already has a {element.tag} named 'tool', so it cannot get a "
                f"Tool: rename the {element.tag}"
            )
    for mesh in robot.iter("mesh"):
        if (path := find_mesh(mesh.get("filename", ""), source)) is not None:
            mesh.set("filename", str(path))
    # Bullet gives a link without <inertial> a mass of 1 kg.
    massless = (
        "<mass value='0'/><inertia ixx='0' iyy='0' izz='0' ixy='0' ixz='0' iyz='0'/>"
    )
    link = f"<link name='tool'><inertial>{massless}</inertial></link>"
    robot.append(ElementTree.fromstring(link))
    x, y, z = check_vector("the position of a tool", tool.position)
    robot.append(
        ElementTree.fromstring(
            f"<joint name='tool' type='fixed'><parent link='{tool.link}'/>"
            f"<child link='tool'/><origin xyz='{x} {y} {z}'/></joint>"
        )
    )
    target = make_scratch_folder() / source.name
    ElementTree.ElementTree(robot).write(target)
    return str(target)
