"""The bodies of a scene in viser's scene tree; needs the extra ``viewer``."""

import io
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
import viser
import yourdfpy
from PIL import Image
from viser.extras import ViserUrdf
from viser.transforms import SE3, SO3

from torch_panda.bullet import Box, Cylinder, PhysicsClient, Scene, Sphere
from torch_panda.bullet.blueprint import CreateBody, LoadURDF, SetBase, SetJoints
from torch_panda.bullet.shapes import LIGHT_GREY
from torch_panda.bullet.urdf import find_mesh, parse_urdf

YELLOW = (255, 190, 0)
SHAPES = ("box", "cylinder", "sphere", "mesh")  # that yourdfpy reads from URDFs

Floats = npt.NDArray[np.float64]


class WebBodies:
    """The bodies of a scene, in the scene tree of a viser server.

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
        self._nodes: dict[int, Any] = {}
        # The URDF of a body, and the names of its joints in Bullet's order.
        self._urdfs: dict[int, tuple[ViserUrdf, list[str]]] = {}
        for command in client.blueprint:
            match command:
                case LoadURDF(body, file):
                    # A URDF's shapes are in the frame of the base. The poses that
                    # Bullet reports, and `_nodes`, are of the base's inertial frame.
                    inertial = _transform(client.inertial_frame(body))
                    base = _transform((*command.position, *command.orientation))
                    name = f"/body{body}"
                    self._nodes[body] = self._add_frame(name, base @ inertial)
                    name = f"{name}/base"
                    self._add_frame(name, inertial.inverse())
                    urdf = ViserUrdf(server, _read_urdf(file), root_node_name=name)
                    names = [joint.name for joint in client.joints(body)]
                    self._urdfs[body] = urdf, names
                    self._set_joints(body, (), ())  # places the links
                case CreateBody(body):
                    node = self._add_shape(f"/body{body}", command)
                    if node is not None:
                        node.position = command.position
                        self._nodes[body] = node
                case SetBase(body, position, orientation) if body in self._nodes:
                    _place(self._nodes[body], np.array((*position, *orientation)))
                case SetJoints(body, joints, positions):
                    self._set_joints(body, joints, positions)
        self._joints = [
            (scene.robot, scene.joints),
            *zip(scene.objects, scene.object_joints, strict=True),
        ]
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
            joint_position: Positions of the robot's joints, then of the objects' joints
                (n_joints,) [rad] or [m].
            object_pose: Poses of the objects (n_objects, 7): position [m], quaternion
                xyzw.
            marker_pose: Poses of the markers (n_markers, 7).
            arrows: Starts and ends of arrows (n, 2, 3), world frame [m].
        """
        first = 0
        for body, joints in self._joints:
            last = first + len(joints)
            if joints:
                self._set_joints(body, joints, joint_position[first:last].tolist())
            first = last
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

    def _add_frame(self, name: str, pose: SE3) -> Any:  # noqa: ANN401 (viser's)
        return self._tree.add_frame(
            name,
            show_axes=False,
            position=pose.translation(),
            wxyz=pose.rotation().wxyz,
        )

    def _set_joints(
        self, body: int, joints: Sequence[int], positions: Sequence[float]
    ) -> None:
        urdf, names = self._urdfs[body]
        moved = [names[joint] for joint in joints]
        urdf.update_cfg(dict(zip(moved, positions, strict=True)))

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


def _read_urdf(file: str) -> yourdfpy.URDF:
    """Read the visual shapes and the joints of a URDF.

    Elements that are not shown go first, because yourdfpy refuses some that Bullet
    accepts, such as capsules and spherical joints. ``mimic`` goes, too: in Bullet, each
    joint has a position of its own. Bullet ignores colours that are not four numbers.
    """
    robot = parse_urdf(file)
    for link in robot.findall("link"):
        for part in list(link):
            geometry = part.find("geometry/*")
            if part.tag != "visual" or geometry is None or geometry.tag not in SHAPES:
                link.remove(part)
    for material in robot.iter("material"):
        for color in material.findall("color"):
            if len(color.get("rgba", "").split()) != 4:
                material.remove(color)
    for joint in robot.findall("joint"):
        if joint.get("type") not in ("revolute", "continuous", "prismatic"):
            joint.set("type", "fixed")
        for part in list(joint):
            if part.tag not in ("parent", "child", "origin", "axis"):
                joint.remove(part)
    return yourdfpy.URDF.load(
        io.BytesIO(ElementTree.tostring(robot)),
        filename_handler=lambda fname: str(find_mesh(fname, Path(file))),
    )


def _transform(pose: Sequence[float]) -> SE3:
    """The transform of a pose (7,): position [m] and quaternion xyzw."""
    rotation = SO3.from_quaternion_xyzw(np.array(pose[3:]))
    return SE3.from_rotation_and_translation(rotation, np.array(pose[:3]))


def _place(node: Any, pose: Floats) -> None:  # noqa: ANN401 (viser's handles)
    """Move a node to a pose (7,): position [m] and quaternion xyzw."""
    node.position = pose[:3]
    node.wxyz = pose[[6, 3, 4, 5]]
