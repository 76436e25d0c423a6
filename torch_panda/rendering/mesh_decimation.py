"""Coarse meshes for small pictures.

The Panda's meshes have 100,000 triangles. In a picture of 64 x 64 pixels, Bullet's
software renderer spends 95 % of the time on triangles that are smaller than a pixel.
"""

import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from torch_panda.bullet.urdf import (
    cache_by_file,
    find_mesh,
    make_scratch_folder,
    parse_urdf,
)

# Texture coordinates in the same cell of this size count as the same colour.
_TEXTURE_CELL = 0.1

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]


@cache_by_file
def decimated_urdf(urdf: str, cell: float) -> Path:
    """Write a copy of a URDF with coarse visual meshes and no collision shapes.

    In .obj meshes, all vertices within a cube of a grid are merged into one vertex.
    Meshes of other formats stay as they are.

    Args:
        urdf: The original file.
        cell: Edge length of the cubes [m].

    Returns:
        Path of the new file.
    """
    source = Path(urdf).absolute()
    robot = parse_urdf(source)
    for link in robot.iter("link"):
        for collision in link.findall("collision"):
            link.remove(collision)
        for mesh in link.iter("mesh"):
            original = find_mesh(mesh.get("filename", ""), source)
            if original is not None and original.suffix == ".obj":
                scale = np.array(mesh.get("scale", "1 1 1").split(), dtype=float)
                original = _coarse_obj(original, cell / scale)
            if original is not None:
                mesh.set("filename", str(original))
    path = make_scratch_folder() / source.name
    ElementTree.ElementTree(robot).write(path)
    return path


def _coarse_obj(original: Path, cell: Floats) -> Path:
    """Write the coarse version of an .obj file and its texture into a new folder.

    Returns:
        Path of the new file; ``original`` if it has no faces.
    """
    vertices, coordinates, corners = _read_obj(original)
    if not len(vertices) or not len(corners):
        return original
    positions, texture, faces = merge_vertices(vertices, coordinates, corners, cell)
    path = make_scratch_folder() / original.name
    lines = [f"v {x:.6f} {y:.6f} {z:.6f}" for x, y, z in positions]
    lines += [f"vt {u:.6f} {v:.6f}" for u, v in texture]
    image = _texture_of(original)
    if image is not None:
        shutil.copy(image, path.parent)
        material = path.with_suffix(".mtl")
        material.write_text(f"newmtl coarse\nmap_Kd {image.name}\n")
        lines = [f"mtllib {material.name}", *lines, "usemtl coarse"]
    normals = _normals(positions, faces)
    lines += [f"vn {x:.4f} {y:.4f} {z:.4f}" for x, y, z in normals]
    lines += [
        "f " + " ".join(f"{v + 1}/{v + 1}/{v + 1}" for v in face) for face in faces
    ]
    path.write_text("\n".join(lines) + "\n")
    return path


def merge_vertices(
    vertices: Floats, coordinates: Floats, corners: Integers, cell: Floats
) -> tuple[Floats, Floats, Integers]:
    """Merge the vertices in each cube of a grid into their mean.

    The method is that of Rossignac and Borrel, "Multi-resolution 3D approximations for
    rendering complex scenes", 1993. Vertices with different texture coordinates get the
    same position but are not merged, because they have different colours.

    Args:
        vertices: Positions (n, 3) [m].
        coordinates: Texture coordinates (m, 2).
        corners: Corners of the triangles (f, 3, 2): index of the vertex, index of the
            texture coordinate.
        cell: Edge lengths of the cubes (3,) [m].

    Returns:
        Positions (k, 3), texture coordinates (k, 2) and triangles (g, 3).
    """
    grid = np.floor(vertices / cell).astype(np.int64)
    _, cube = np.unique(grid, axis=0, return_inverse=True)
    sums = np.stack([np.bincount(cube, column) for column in vertices.T], axis=1)
    means: Floats = sums / np.bincount(cube)[:, None]
    color = np.floor(coordinates / _TEXTURE_CELL).astype(np.int64)
    # Make a new vertex for each pair of cube and colour. It takes its texture
    # coordinates from one of the corners that it replaces.
    flat = corners.reshape(-1, 2)
    keys = np.column_stack((cube[flat[:, 0]], color[flat[:, 1]]))
    keys, first, index = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    faces = index.reshape(-1, 3)
    # Remove triangles that shrank to a line or a point. Then remove duplicates: rotate
    # the corners of each triangle so that the cube with the lowest number comes first,
    # and keep one of the triangles that are now equal.
    in_cubes = keys[faces, 0]
    has_area = (in_cubes != np.roll(in_cubes, 1, axis=1)).all(axis=1)
    faces, in_cubes = faces[has_area], in_cubes[has_area]
    lowest = in_cubes.argmin(axis=1)
    turned = (lowest[:, None] + np.arange(3)) % 3
    in_cubes = np.take_along_axis(in_cubes, turned, axis=1)
    _, kept = np.unique(in_cubes, axis=0, return_index=True)
    return means[keys[:, 0]], coordinates[flat[first, 1]], faces[np.sort(kept)]


def _normals(positions: Floats, faces: Integers) -> Floats:
    """Normals of vertices: means over their triangles, weighted by area."""
    a, b, c = positions[faces[:, 0]], positions[faces[:, 1]], positions[faces[:, 2]]
    normals = np.zeros_like(positions)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def _read_obj(path: Path) -> tuple[Floats, Floats, Integers]:
    """Vertices (n, 3), texture coordinates (m, 2), corners (f, 3, 2) of an .obj file.

    Texture coordinate 0 is (0, 0), for corners that have none in the file.
    """
    vertices: list[list[float]] = []
    coordinates = [[0.0, 0.0]]
    corners: list[list[tuple[int, int]]] = []
    for line in path.read_text(errors="replace").splitlines():
        keyword, *values = line.split() or [""]
        if keyword == "v":
            vertices.append([float(x) for x in values[:3]])
        elif keyword == "vt":  # numbers may be missing
            coordinates.append([float(x) for x in (*values, "0", "0")[:2]])
        elif keyword == "f":
            polygon = []
            for corner in values:
                vertex, coordinate = [*corner.split("/"), ""][:2]
                # Indices count from 1, or backwards from the last element so far.
                v, t = int(vertex), int(coordinate or 0)
                v = v - 1 if v > 0 else v + len(vertices)
                polygon.append((v, t if t >= 0 else t + len(coordinates)))
            for k in range(1, len(polygon) - 1):
                corners.append([polygon[0], polygon[k], polygon[k + 1]])
    return np.array(vertices), np.array(coordinates), np.array(corners)


def _texture_of(path: Path) -> Path | None:
    """The first texture in the materials of an .obj file, as Bullet uses only one."""
    for library in _values(path, "mtllib"):
        materials = path.parent / library
        if materials.is_file():
            for name in _values(materials, "map_Kd"):
                if (image := materials.parent / name).is_file():
                    return image
    return None


def _values(path: Path, key: str) -> Iterator[str]:
    """The last words of the lines of a text file that begin with ``key``."""
    with path.open(errors="replace") as lines:
        for line in lines:
            words = line.split()
            if words[:1] == [key]:
                yield words[-1]
