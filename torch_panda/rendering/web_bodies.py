"""The bodies of a scene in viser's scene tree; needs the extra ``viewer``."""

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
import viser
from PIL import Image
from viser.transforms import SO3

from torch_panda.bullet import Box, Cylinder, PhysicsClient, Scene, Sphere
from torch_panda.bullet.blueprint import CreateBody, LoadURDF, SetBase
from torch_panda.bullet.shapes import LIGHT_GREY
from torch_panda.rendering.mesh_decimation import decimated_urdf

MESH_CELL = 0.003  # edge length of the cells in which vertices are merged [m]
YELLOW = (255, 190, 0)

Floats = npt.NDArray[np.float64]
# A movable joint: node of the link that it moves, origin and rotation in the parent's
# frame, axis, and whether it is prismatic (otherwise revolute).
Joint = tuple[Any, Floats, SO3, Floats, bool]


class WebBodies:
    """The bodies of a scene, drawn by a viser server.

    Args:
        server: The server.
        client: A physics client with the scene, which has the blueprint and the joints.
        scene: Body ids of the scene.
    """

    def __init__(
        self, server: viser.ViserServer, client: PhysicsClient, scene: Scene
    ) -> None:
        self._tree = server.scene
        self._tree.set_up_direction("+z")
        self._joints: list[Joint] = []
        self._nodes: dict[int, Any] = {}
        for command in client.blueprint:
            match command:
                case LoadURDF(body):
                    name = f"/body{body}"
                    node = self._tree.add_frame(name, show_axes=False)
                    _place(node, np.array((*command.position, *command.orientation)))
                    self._nodes[body] = node
                    movable = [x.name for x in client.joints(body) if x.is_movable]
                    handles = self._add_urdf(name, command.file, movable)
                    if body == scene.robot:
                        self._joints = [handles[joint] for joint in movable]
                case CreateBody(body):
                    node = self._add_shape(f"/body{body}", command)
                    if node is not None:
                        node.position = command.position
                        self._nodes[body] = node
                case SetBase(body, position, orientation) if body in self._nodes:
                    _place(self._nodes[body], np.array((*position, *orientation)))
        self._objects = [self._nodes.get(body) for body in scene.objects]
        self._markers = [self._nodes.get(body) for body in scene.markers]

    def show(
        self,
        joint_position: Floats,
        object_pose: Floats,
        marker_pose: Floats,
        arrows: Floats,
    ) -> None:
        """Show the bodies of one environment, and arrows for contact forces.

        Args:
            joint_position: Positions of the robot's joints (n_joints,) [rad] or [m].
            object_pose: Poses of the objects (n_objects, 7): position [m], quaternion
                xyzw.
            marker_pose: Poses of the markers (n_markers, 7).
            arrows: Starts and ends of arrows (n, 2, 3), world frame [m].
        """
        for (node, origin, rotation, axis, is_prismatic), q in zip(
            self._joints, joint_position, strict=True
        ):
            if is_prismatic:
                node.position = origin + rotation @ (axis * q)
            else:
                node.wxyz = (rotation @ SO3.exp(axis * q)).wxyz
        for nodes, poses in (
            (self._objects, object_pose),
            (self._markers, marker_pose),
        ):
            for node, pose in zip(nodes, poses, strict=True):
                if node is not None:
                    _place(node, pose)
        self._tree.add_arrows(
            "/contacts",
            arrows,
            YELLOW,
            shaft_radius=0.003,
            head_radius=0.007,
            head_length=0.015,
            visible=len(arrows) > 0,
        )

    # ---- building ----------------------------------------------------------------

    def _add_urdf(self, root: str, file: str, movable: list[str]) -> dict[str, Joint]:
        """Add a node for each link of a body, as a child of its parent link's node.

        The browser then computes the poses of the links from those of the joints.
        ``root`` is the name of the body's node. The result holds the movable joints, by
        name.
        """
        source = decimated_urdf(file, MESH_CELL)
        tree = ElementTree.parse(source)
        colors = {
            material.get("name"): _numbers(color.get("rgba"), (1, 1, 1, 1))
            for material in tree.iter("material")
            if (color := material.find("color")) is not None
        }
        joints = {x.find("child").get("link"): x for x in tree.findall("joint")}  # type: ignore[union-attr]
        names: dict[str, str] = {}
        handles: dict[str, Joint] = {}

        def node_path(link: str) -> str:
            """Name of a link's node. Adds the node if it does not exist."""
            if link in names:
                return names[link]
            joint = joints.get(link)
            if joint is None:
                names[link] = root
                return root
            parent = joint.find("parent").get("link")  # type: ignore[union-attr]
            names[link] = f"{node_path(parent)}/{link}"  # type: ignore[arg-type]
            origin, rotation = _origin(joint)
            node = self._tree.add_frame(
                names[link], show_axes=False, position=origin, wxyz=rotation.wxyz
            )
            axis = joint.find("axis")
            direction = _numbers(None if axis is None else axis.get("xyz"), (1, 0, 0))
            if joint.get("name") in movable:
                is_prismatic = joint.get("type") == "prismatic"
                handles[str(joint.get("name"))] = (
                    node, origin, rotation, direction, is_prismatic,
                )  # fmt: skip
            return names[link]

        for link in tree.findall("link"):
            parent = node_path(str(link.get("name")))
            for k, visual in enumerate(link.findall("visual")):
                material = visual.find("material")
                name = None if material is None else material.get("name")
                mesh = _read_mesh(visual, source)
                if mesh is not None:
                    node_name = f"{parent}/visual{k}"
                    origin, rotation = _origin(visual)
                    pose = {"position": origin, "wxyz": rotation.wxyz}
                    if _has_texture(mesh):
                        self._tree.add_mesh_trimesh(node_name, mesh, **pose)
                    else:
                        self._tree.add_mesh_simple(
                            node_name,
                            mesh.vertices,
                            mesh.faces,
                            color=colors.get(name, np.ones(4))[:3],
                            **pose,
                        )
        return handles

    def _add_shape(self, name: str, body: CreateBody) -> Any:  # noqa: ANN401 (viser's)
        """Add a body. Return its node, or None for an invisible marker."""
        visual, shape = body.visual, body.shape
        if isinstance(shape, Box) and visual.texture is not None and not body.is_marker:
            return self._tree.add_mesh_trimesh(
                name, textured_box(shape, visual.texture)
            )
        appearance: dict[str, Any] = {
            "color": visual.color if visual.texture is None else LIGHT_GREY,
            "opacity": visual.opacity if body.is_marker else None,
        }
        match shape:
            case Box(half_extents):
                size = tuple(2 * x for x in half_extents)
                return self._tree.add_box(name, dimensions=size, **appearance)
            case Cylinder(radius, height):
                return self._tree.add_cylinder(name, radius, height, **appearance)
            case Sphere(radius):
                return self._tree.add_icosphere(name, radius, **appearance)
        return None


def textured_box(box: Box, texture: Path) -> trimesh.Trimesh:
    """A box, each face in the colour at the centre of its square; see `Visual`."""
    mesh = trimesh.creation.box(extents=[2 * x for x in box.half_extents])
    mesh.unmerge_vertices()
    axis = np.abs(mesh.face_normals).argmax(axis=1)
    below = mesh.face_normals.sum(axis=1) < 0
    middle = np.stack(((axis + 0.5) / 3, np.where(below, 0.25, 0.75)), axis=1)
    mesh.visual = trimesh.visual.TextureVisuals(
        uv=np.repeat(middle, 3, axis=0),
        # A metallic material would look black, because the scene has nothing to
        # reflect.
        material=trimesh.visual.material.PBRMaterial(
            baseColorTexture=Image.open(texture).convert("RGB"),
            metallicFactor=0.0,
            roughnessFactor=0.8,
        ),
    )
    return mesh


def _read_mesh(visual: ElementTree.Element, urdf: Path) -> trimesh.Trimesh | None:
    """The mesh of a visual of a URDF; None for an unknown geometry."""
    if (geometry := visual.find("geometry/*")) is None:
        return None
    match geometry.tag:
        case "mesh":
            mesh = trimesh.load(
                urdf.parent / str(geometry.get("filename")), force="mesh"
            )
            return mesh.apply_scale(_numbers(geometry.get("scale"), (1, 1, 1)))
        case "box":
            return trimesh.creation.box(_numbers(geometry.get("size"), (1, 1, 1)))
        case "sphere":
            return trimesh.creation.icosphere(radius=float(geometry.get("radius", 1)))
        case "cylinder":
            radius, length = (float(geometry.get(x, 1)) for x in ("radius", "length"))
            return trimesh.creation.cylinder(radius, length)
    return None


def _has_texture(mesh: trimesh.Trimesh) -> bool:
    """Whether a mesh has a texture of its own."""
    if mesh.visual.kind != "texture":
        return False
    # A mesh without a texture has a placeholder of 2 x 2 pixels.
    image = mesh.visual.material.image
    return image is not None and image.width > 2


def _origin(element: ElementTree.Element) -> tuple[Floats, SO3]:
    """Position [m] and rotation of a joint or a visual in its link's frame."""
    origin = element.find("origin")
    attributes = {} if origin is None else origin.attrib
    position = _numbers(attributes.get("xyz"), (0, 0, 0))
    return position, SO3.from_rpy_radians(*_numbers(attributes.get("rpy"), (0, 0, 0)))


def _numbers(text: str | None, default: tuple[float, ...]) -> Floats:
    return np.array(default if text is None else text.split(), dtype=float)


def _place(node: Any, pose: Floats) -> None:  # noqa: ANN401 (viser's handles)
    """Move a node to a pose (7,): position [m] and quaternion xyzw."""
    node.position = pose[:3]
    node.wxyz = pose[[6, 3, 4, 5]]
