"""The rasterizer against a test of every pixel against every face; pictures by their content."""

import numpy as np
import pytest
import trimesh
from matplotlib.image import imread

from hiosdf_jax._src.view import shading
from hiosdf_jax.pictures import save_shaded


def brute_force(corners, width, height):
    """Face and depth at each pixel, from barycentric coordinates of every pixel in every face."""
    face, depth = np.full((height, width), -1), np.full((height, width), np.inf)
    rows, columns = np.indices((height, width))
    for i, (a, b, c) in enumerate(corners):
        matrix = np.array([[a[0], b[0], c[0]], [a[1], b[1], c[1]], [1, 1, 1]])
        if abs(np.linalg.det(matrix)) < 1e-9:
            continue
        weights = np.linalg.inv(matrix) @ np.stack([columns, rows, np.ones_like(rows)]).reshape(
            3, -1
        )
        inside = (weights >= 0).all(axis=0).reshape(height, width)
        z = ([a[2], b[2], c[2]] @ weights).reshape(height, width)
        nearer = inside & (z < depth)
        face[nearer], depth[nearer] = i, z[nearer]
    return face, depth


@pytest.mark.parametrize("spread", [2.0, 30.0])
def test_the_rasterizer_equals_brute_force(spread):
    rng = np.random.default_rng(0)
    width, height = 61, 47
    center = rng.uniform([0, 0, 0], [width, height, 50], (60, 3))
    corners = center[:, None] + rng.uniform(-spread, spread, (60, 3, 3))
    corners[..., :2] = np.clip(corners[..., :2], 0.3, [width - 1.3, height - 1.3])
    corners[..., 2] = np.abs(corners[..., 2])
    face, depth = shading._rasterize(corners, width, height)
    expected_face, expected_depth = brute_force(corners, width, height)
    np.testing.assert_array_equal(face, expected_face)
    np.testing.assert_allclose(depth, expected_depth, atol=1e-4)


def test_the_rasterizer_leaves_no_cracks(monkeypatch):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 99, (3000, 2))
    points = np.concatenate([points, [[0, 0], [99, 0], [0, 99], [99, 99]]])
    points[:500] = np.rint(points[:500])  # corners on pixel centers, level edges
    from scipy.spatial import Delaunay

    corners = np.concatenate([points, np.ones((len(points), 1))], axis=-1)
    triangles = corners[Delaunay(points).simplices]
    face, depth = shading._rasterize(triangles, 100, 100)
    assert (face >= 0).all()
    np.testing.assert_allclose(depth, 1, atol=1e-6)
    # Many batches give the same as one.
    monkeypatch.setattr(shading, "_FACES_PER_BATCH", 97)
    np.testing.assert_array_equal(shading._rasterize(triangles, 100, 100)[1], depth)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.3, -0.5, 2.0)])
def test_the_camera_looks_down_along_the_long_side(up):
    up = np.array(up) / np.linalg.norm(up)
    right = np.cross(up, [1, 0, 0.1])
    right /= np.linalg.norm(right)
    # 8 m x 3 m x 1 m, in a frame whose third axis is `up`
    frame = np.stack([right, np.cross(up, right), up])
    box = np.random.default_rng(0).uniform(-1, 1, (2000, 3)) * [4, 1.5, 0.5] @ frame
    axes = shading._camera_axes(box, up)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0  # not mirrored
    assert axes[0] @ up == pytest.approx(0, abs=1e-12)  # no roll
    assert axes[1] @ up > 0.5
    assert axes[2] @ up == pytest.approx(np.sin(np.deg2rad(52)))
    assert abs(axes[0] @ right) > np.cos(np.deg2rad(30))


def room():
    """A box with its faces inwards, like the map of a room, and a table on its floor."""
    walls = trimesh.creation.box(extents=(6, 4, 2.5))
    walls.invert()
    table = trimesh.creation.box(extents=(1, 1, 1))
    table.apply_translation([1, 0, -0.75])
    return trimesh.util.concatenate([walls, table])


def test_the_view_passes_into_a_room(tmp_path):
    path = tmp_path / "room.png"
    save_shaded(path, room(), size=(320, 240))
    inside = imread(path)[..., :3]
    assert inside.shape == (240, 320, 3)
    assert (inside[0] == 1).all()  # white around
    assert 0.2 < (inside.min(axis=-1) < 1).mean() < 0.9
    solid = trimesh.creation.box(extents=(6, 4, 2.5))
    save_shaded(path, solid, size=(320, 240))
    outside = imread(path)[..., :3]

    # A box from outside shows its lid in one color, the top of the palette; the room does not.
    def reddish(image):
        return ((image[..., 0] > image[..., 2] + 0.2) & (image.min(axis=-1) < 0.7)).mean()

    assert reddish(outside) > 3 * reddish(inside) + 0.1


def test_the_picture_does_not_depend_on_the_frame(tmp_path):
    mesh = room()
    save_shaded(tmp_path / "a.png", mesh, size=(160, 120))
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y down, as in a camera's frame
    turned = trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces, process=False)
    save_shaded(tmp_path / "b.png", turned, size=(160, 120), up_world=turn @ [0, 0, 2])
    a, b = imread(tmp_path / "a.png"), imread(tmp_path / "b.png")
    assert np.abs(a - b).max() < 0.02


def test_faces_that_look_away_leave_white(tmp_path):
    ceiling = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 2, 1]], process=False)
    save_shaded(tmp_path / "a.png", ceiling, size=(32, 20))
    assert (imread(tmp_path / "a.png")[..., :3] == 1).all()


def test_messages_name_the_wrong_argument(tmp_path):
    with pytest.raises(ValueError, match="mesh has 0 faces"):
        save_shaded(tmp_path / "a.png", trimesh.Trimesh())
    with pytest.raises(ValueError, match="size = "):
        save_shaded(tmp_path / "a.png", room(), size=(0, 20))
    for up in ((0, 0, 0), (0, 1), (np.nan, 0, 1)):
        with pytest.raises(ValueError, match="up_world = "):
            save_shaded(tmp_path / "a.png", room(), up_world=up)


def test_small_pieces_near_the_top_are_remains_of_a_ceiling():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    # A floor, a small piece high up, a small one low down (a chair's seat), a large one high up.
    places = np.array([[0, 0, 0], [2, 2, 2.4], [5, 5, 0.5], [0, 0, 2.5]])
    pieces = [edge * square + place for edge, place in zip((10, 1, 1, 5), places, strict=True)]
    vertices = np.concatenate(pieces)
    faces = np.array([[4 * k, 4 * k + i, 4 * k + i + 1] for k in range(4) for i in (1, 2)])
    area = np.repeat([50.0, 0.5, 0.5, 12.5], 2)
    remains = shading.remains_of_ceiling(vertices[:, 2], faces, area)
    assert remains.tolist() == [False] * 2 + [True] * 2 + [False] * 4
