"""Exact distances of meshes and grids against closed forms."""

import json
import struct
import tracemalloc

import numpy as np
import pytest
import trimesh
from pole_room import ORIGIN, POLE, box_sdf, points_in, room_mesh, room_stream, slopes, write_grid

pytest.importorskip("igl")

from hiosdf_jax._src.scoring.scene import grid_scene
from hiosdf_jax.scoring import mesh_scene, read_rays, read_scene, sensor_path


@pytest.mark.parametrize("inside_out", [False, True])
def test_a_watertight_box_is_signed_by_its_solid(inside_out):
    half = np.array([0.5, 0.3, 0.2])
    mesh = trimesh.creation.box(2 * half)
    if inside_out:
        mesh.invert()
    points = points_in(-1, 1)
    sdf, grad = mesh_scene(mesh, ORIGIN).sdf_and_grad(points)
    sign = -1 if inside_out else 1
    expected = sign * box_sdf(points, half)
    np.testing.assert_allclose(sdf, expected, atol=1e-12)
    assert {*np.sign(sdf)} == {-1, 1}
    np.testing.assert_array_equal(mesh_scene(mesh, ORIGIN).sdf_to_draw(points), sdf)
    outside = sign * sdf > 0.01  # inside, the slopes of a box have creases
    numeric = slopes(lambda p: sign * box_sdf(p, half), points[outside])
    np.testing.assert_allclose(grad[outside], numeric, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(grad, axis=-1), 1, atol=1e-9)
    on_face = np.array([[0.5, 0.1, 0.05]])
    np.testing.assert_allclose(mesh_scene(mesh, ORIGIN).sdf_and_grad(on_face)[1], [[sign, 0, 0]])


def test_overlapping_bodies_are_one_solid():
    """Inside the wall that both share, a normal alone would give "outside"."""
    left, right = trimesh.creation.box([1, 1, 1]), trimesh.creation.box([1, 1, 1])
    right.apply_translation([0.6, 0, 0])
    mesh = trimesh.util.concatenate([left, right])
    points = points_in([-0.9, -0.9, -0.9], [1.5, 0.9, 0.9])
    sdf, _ = mesh_scene(mesh, ORIGIN).sdf_and_grad(points)
    union = np.minimum(box_sdf(points, np.full(3, 0.5)), box_sdf(points - [0.6, 0, 0], 0.5))
    np.testing.assert_array_equal(sdf > 0, union > 0)


def test_a_sheet_is_signed_by_the_views_of_the_sensor():
    wall = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]])
    points = points_in([-1, -0.9, -0.9], [1, 0.9, 0.9])
    points = points[np.abs(points[:, 0]) > 1e-3]
    in_front = mesh_scene(wall, np.array([[1.0, 0, 0]]))
    sdf, grad = in_front.sdf_and_grad(points)
    # The shadow of the wall: the points behind it as seen from (1, 0, 0).
    at_wall = 1 / np.maximum(1 - points[:, 0], 1e-9)
    shadow = (points[:, 0] < 0) & (np.abs(points[:, 1:] * at_wall[:, None]).max(axis=-1) < 1)
    assert 0.1 < shadow.mean() < 0.9
    np.testing.assert_array_equal(sdf < 0, shadow)
    np.testing.assert_allclose(np.abs(sdf), np.abs(points[:, 0]), atol=1e-12)
    np.testing.assert_allclose(
        grad,
        np.tile([[1.0, 0, 0]], (len(points), 1))
        * np.where(shadow | (points[:, 0] > 0), 1, -1)[:, None],
        atol=1e-12,
    )
    np.testing.assert_allclose(in_front.sdf_to_draw(points), np.abs(sdf), atol=1e-12)
    both = mesh_scene(wall, np.array([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert (both.sdf_and_grad(points)[0] > 0).all()


def test_rays_meet_the_room_and_its_thin_part():
    stream = room_stream(noise=0)
    rays = read_rays(stream)
    assert len(rays.range) == 6 * 3000 and {*rays.frame} == set(range(6))
    np.testing.assert_allclose(sensor_path(rays)[3], [-0.2, -0.2, 0.1], atol=1e-6)
    hits = mesh_scene(room_mesh(), sensor_path(rays)).cast(rays.origin_world, rays.direction_world)
    grazing = np.abs(hits.range - rays.range) > 1e-4  # marching stops short along the pole
    assert grazing.mean() < 0.002
    ends = rays.origin_world + hits.range[:, None] * rays.direction_world
    on_pole = np.abs(ends[:, :2] - POLE).max(axis=-1) < 0.0151
    np.testing.assert_array_equal(hits.thin_part >= 0, on_pole)
    assert on_pole.sum() > 100
    miss = mesh_scene(room_mesh(), ORIGIN).cast(np.array([[9.0, 0, 0]]), np.array([[1.0, 0, 0]]))
    assert miss.range[0] == np.inf and miss.thin_part[0] == -1


def test_sheets_and_thick_bodies_are_not_thin_parts():
    crate = trimesh.creation.box([0.06, 0.06, 0.06])
    board = trimesh.creation.box([0.5, 0.04, 0.3])
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])
    board.apply_transform(turn)
    board.apply_translation([2, 0, 0])
    sheet = trimesh.Trimesh([[4, -1, -1], [4, 1, -1], [4, 1, 1]], [[0, 1, 2]])
    scene = mesh_scene(trimesh.util.concatenate([crate, board, sheet]), ORIGIN)
    targets = np.array([[0, 0, 0], [2, 0, 0], [4, 0.1, 0]])
    along = np.tile([[0.0, 0, 1.0]], (3, 1))
    along[1] = turn[:3, 1]
    along[2] = [1, 0, 0]
    hits = scene.cast(targets - along, along)
    np.testing.assert_allclose(hits.range, [0.97, 0.98, 1], atol=1e-9)
    assert (hits.thin_part >= 0).tolist() == [False, True, False]


def test_a_grid_of_samples(tmp_path):
    def sphere(points):
        return np.linalg.norm(points - [0.1, 0.2, -0.1], axis=-1) - 0.5

    low, high = write_grid(tmp_path, sphere)
    points = points_in(low + 0.05, high - 0.05)
    for place in (tmp_path, tmp_path / "sdf.npy"):
        sdf, grad = read_scene(place, ORIGIN).sdf_and_grad(points)
        np.testing.assert_array_equal(read_scene(place, ORIGIN).sdf_to_draw(points), sdf)
        # Trilinear: the error is at most h^2 / 8 times the second derivatives, which sum to 2 / r.
        far = np.linalg.norm(points - [0.1, 0.2, -0.1], axis=-1) > 0.2
        assert far.mean() > 0.9
        np.testing.assert_allclose(sdf[far], sphere(points[far]), atol=0.04**2 / 8 * 2 / 0.2)
        true = slopes(sphere, points[far])
        assert ((true * grad[far]).sum(axis=-1) > 0.99).all()
        np.testing.assert_allclose(np.linalg.norm(grad[far], axis=-1), 1, atol=1e-9)
    outside = np.stack([low - 0.01, high + 0.1])
    sdf, grad = grid_scene(tmp_path).sdf_and_grad(outside)
    assert np.isnan(sdf).all() and np.isnan(grad).all()


def test_messages_name_the_bad_scene(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_scene(tmp_path / "none.ply", ORIGIN)
    with pytest.raises(FileNotFoundError, match=r"sdf\.npy"):
        read_scene(tmp_path, ORIGIN)
    text = tmp_path / "text.ply"
    text.write_text("not a mesh")
    with pytest.raises(ValueError, match=r"text\.ply: not a readable mesh"):
        read_scene(text, ORIGIN)
    with pytest.raises(ValueError, match="0 triangles"):
        mesh_scene(trimesh.Trimesh(), ORIGIN)
    with pytest.raises(ValueError, match=r"sensor_path_world has shape \(3,\)"):
        mesh_scene(room_mesh(), np.zeros(3))
    for values, message in (
        (np.zeros((3, 3)), r"sdf.npy: has shape \(3, 3\)"),
        (np.zeros((3, 3, 3), int), "sdf.npy: has type int64"),
    ):
        np.save(tmp_path / "sdf.npy", values)
        with pytest.raises(ValueError, match=message):
            grid_scene(tmp_path)
    np.save(tmp_path / "sdf.npy", np.zeros((3, 3, 3)))
    for text, message in (
        ("1 0 0", "transform.txt, line 1: 3 columns, expected 4"),
        ("1 0 0 0", r"transform.txt: has shape \(1, 4\)"),
        ("a b c d", "transform.txt, line 1: could not convert"),
        ("0 1 0 0\n1 0 0 0\n0 0 1 0\n0 0 0 1", "expected nothing but spacings"),
        ("-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "expected nothing but spacings"),
    ):
        (tmp_path / "transform.txt").write_text(text)
        with pytest.raises(ValueError, match=message):
            grid_scene(tmp_path)


def glb_with_index(index):
    """A box whose first triangle has this corner."""
    content = bytearray(trimesh.creation.box((2, 2, 2)).export(file_type="glb"))
    start = 20 + struct.unpack("<I", content[12:16])[0]
    header = json.loads(content[20:start])
    accessor = next(each for each in header["accessors"] if each["type"] == "SCALAR")
    view = header["bufferViews"][accessor["bufferView"]]
    struct.pack_into("<I", content, start + 8 + view.get("byteOffset", 0), index)
    return bytes(content)


def glb(**header):
    """A file without arrays."""
    text = json.dumps({"asset": {"version": "2.0"}} | header).encode()
    text += b" " * (-len(text) % 4)
    sizes = struct.pack("<III", 2, 20 + len(text), len(text))
    return b"glTF" + sizes + b"JSON" + text


def many_nodes(count, **node):
    accessors = [{"componentType": 5126, "count": 100, "type": "VEC3"}]
    meshes = [{"primitives": [{"attributes": {"POSITION": 0}}]}]
    nodes = [{"mesh": 0} | node] * count
    scenes = [{"nodes": list(range(count))}]
    return glb(accessors=accessors, meshes=meshes, nodes=nodes, scenes=scenes, scene=0)


def ply(vertices, faces=1, gap=" ", before=""):
    return (
        f"ply\nformat ascii 1.0\n{before}element{gap}vertex {vertices}\nproperty float x\n"
        f"property float y\nproperty float z\nelement face {faces}\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n"
    ).encode()


BOX = trimesh.creation.box((2, 2, 2))
BAD_MESHES = {
    "large.glb": (glb_with_index(16384), "corners 0 to 16384, expected 0 to 7"),
    "negative.glb": (glb_with_index(2**32 - 7), "expected 0 to 7"),
    "array.glb": (glb(accessors=[{"count": 10**9, "type": "VEC3"}]), "declares arrays of"),
    "copies.glb": (many_nodes(30_000), "3000000 corners, expected at most 2097152"),
    "parents.glb": (many_nodes(3, children=[0]), "a node has two parents"),
    "index.ply": (ply(3), "corners 0 to 9, expected 0 to 2"),
    "vertices.ply": (ply(500_000_000, gap="\t"), "declares 500000000 of vertex"),
    "faces.ply": (ply(3, 2_000_000_000), "declares 2000000000 of face"),
    "comments.ply": (ply(3, before="comment\n" * 10_000), "no end of a header"),
    "flat.obj": (b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", r"corners of shape \(.*, 2\)|shape"),
    "far.obj": (b"v 0 0 0\nv 1e30 0 0\nv 0 1 0\nf 1 2 3\n", r"corners 1e\+30 m away"),
    "endless.obj": (b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", "not finite"),
    "index.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 9\n", "index|corners"),
    "archive.3mf": (b"PK", r"no mesh, expected one of \.ply, .*\.glb$"),
    "other.gltf": (b"{}", r"no mesh, expected one of \.ply, .*\.glb$"),
}


@pytest.mark.parametrize("name", BAD_MESHES)
def test_damaged_meshes_are_refused_before_foreign_code_reads_them(tmp_path, name):
    content, message = BAD_MESHES[name]
    (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    with pytest.raises(ValueError, match=message) as error:
        read_scene(tmp_path / name, ORIGIN)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert str(error.value).startswith(str(tmp_path / name)) and "\n" not in str(error.value)
    assert peak < 50e6


@pytest.mark.parametrize("faces", [[[0, 1, 8]], [[0, 1, -1]]])
def test_triangles_without_corners_are_refused(faces):
    mesh = trimesh.Trimesh(BOX.vertices, faces, process=False)
    with pytest.raises(ValueError, match="expected 0 to 7"):
        mesh_scene(mesh, ORIGIN)


@pytest.mark.parametrize("kind", ["ply", "obj", "stl", "off", "glb", "PLY"])
def test_meshes_of_any_format_are_the_same(tmp_path, kind):
    path = tmp_path / f"box.{kind}"
    path.write_bytes(b"")
    BOX.export(path, file_type=kind.lower())
    points = points_in(-2, 2, 200)
    found = read_scene(path, ORIGIN).sdf_and_grad(points)[0]
    np.testing.assert_allclose(found, box_sdf(points, np.ones(3)), atol=1e-6)
