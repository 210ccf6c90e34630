"""The rasteriser against a test of every pixel against every face; pictures by what they show."""

import subprocess
import sys

import numpy as np
import pytest
import trimesh
from matplotlib import colormaps
from matplotlib.image import imread

from hiosdf_jax._src.view import shading, slices
from hiosdf_jax.view import save_shaded, save_slices

BOUNDS = ((-2.0, -1.0, 0.0), (2.0, 1.0, 1.0))


def brute_force(corners, width, height):
    """Face and depth at each pixel, by barycentric coordinates of every pixel in every face."""
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
def test_rasteriser_equals_brute_force(spread):
    rng = np.random.default_rng(0)
    width, height = 61, 47
    centre = rng.uniform([0, 0, 0], [width, height, 50], (60, 3))
    corners = centre[:, None] + rng.uniform(-spread, spread, (60, 3, 3))
    corners[..., :2] = np.clip(corners[..., :2], 0.3, [width - 1.3, height - 1.3])
    corners[..., 2] = np.abs(corners[..., 2])
    face, depth = shading._rasterise(corners, width, height)
    expected_face, expected_depth = brute_force(corners, width, height)
    np.testing.assert_array_equal(face, expected_face)
    np.testing.assert_allclose(depth, expected_depth, atol=1e-4)


def test_rasteriser_leaves_no_cracks(monkeypatch):
    rng = np.random.default_rng(1)
    points = rng.uniform(0, 99, (3000, 2))
    points = np.concatenate([points, [[0, 0], [99, 0], [0, 99], [99, 99]]])
    points[:500] = np.rint(points[:500])  # corners on pixel centres, level edges
    from scipy.spatial import Delaunay

    corners = np.concatenate([points, np.ones((len(points), 1))], axis=-1)
    triangles = corners[Delaunay(points).simplices]
    face, depth = shading._rasterise(triangles, 100, 100)
    assert (face >= 0).all()
    np.testing.assert_allclose(depth, 1, atol=1e-6)
    # In many batches as in one.
    monkeypatch.setattr(shading, "_FACES_PER_BATCH", 97)
    np.testing.assert_array_equal(shading._rasterise(triangles, 100, 100)[1], depth)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.3, -0.5, 2.0)])
def test_camera_looks_down_along_the_long_side(up):
    up = np.array(up) / np.linalg.norm(up)
    right = np.cross(up, [1, 0, 0.1])
    right /= np.linalg.norm(right)
    # 8 m x 3 m x 1 m, in a frame of which `up` is the third axis
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
    """A box with its faces inwards, as a map of a room has them, and a table on its floor."""
    walls = trimesh.creation.box(extents=(6, 4, 2.5))
    walls.invert()
    table = trimesh.creation.box(extents=(1, 1, 1))
    table.apply_translation([1, 0, -0.75])
    return trimesh.util.concatenate([walls, table])


def test_one_looks_into_a_room(tmp_path):
    path = tmp_path / "room.png"
    save_shaded(path, room(), size=(320, 240))
    inside = imread(path)[..., :3]
    assert inside.shape == (240, 320, 3)
    assert (inside[0] == 1).all()  # white around
    assert 0.2 < (inside.min(axis=-1) < 1).mean() < 0.9
    solid = trimesh.creation.box(extents=(6, 4, 2.5))
    save_shaded(path, solid, size=(320, 240))
    outside = imread(path)[..., :3]

    # The outside of a box shows its lid in one colour (the top of the palette), the room does not.
    def reddish(image):
        return ((image[..., 0] > image[..., 2] + 0.2) & (image.min(axis=-1) < 0.7)).mean()

    assert reddish(outside) > 3 * reddish(inside) + 0.1


def test_turning_the_world_turns_nothing(tmp_path):
    mesh = room()
    save_shaded(tmp_path / "a.png", mesh, size=(160, 120))
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # y down, as in a camera's frame
    turned = trimesh.Trimesh(mesh.vertices @ turn.T, mesh.faces, process=False)
    save_shaded(tmp_path / "b.png", turned, size=(160, 120), up_world=turn @ [0, 0, 2])
    a, b = imread(tmp_path / "a.png"), imread(tmp_path / "b.png")
    assert np.abs(a - b).max() < 0.02


def test_nothing_to_see_is_white(tmp_path):
    ceiling = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 2, 1]], process=False)
    save_shaded(tmp_path / "a.png", ceiling, size=(32, 20))
    assert (imread(tmp_path / "a.png")[..., :3] == 1).all()


def test_shaded_misuse_is_named(tmp_path):
    with pytest.raises(ValueError, match="mesh has 0 faces"):
        save_shaded(tmp_path / "a.png", trimesh.Trimesh())
    with pytest.raises(ValueError, match="size = "):
        save_shaded(tmp_path / "a.png", room(), size=(0, 20))
    for up in ((0, 0, 0), (0, 1), (np.nan, 0, 1)):
        with pytest.raises(ValueError, match="up_world = "):
            save_shaded(tmp_path / "a.png", room(), up_world=up)


def disc(points):
    return np.linalg.norm(points[:, :2], axis=-1) - 0.5


def share_of(image, colour):
    return (np.abs(image[..., :3] - np.array(colour[:3])).max(axis=-1) < 0.02).mean()


@pytest.mark.parametrize("error", [-0.2, 0.0, 0.2])
def test_slices_show_the_sign_of_the_error(tmp_path, error):
    path = tmp_path / "slices.png"
    save_slices(path, lambda p: disc(p) + error, disc, BOUNDS, [0.2, 0.7])
    image = imread(path)
    image = image[:, 2 * image.shape[1] // 3 :][: int(0.75 * image.shape[0])]  # the errors' column
    scale = colormaps["PuOr_r"]
    shares = [share_of(image, scale(value)) for value in (0.0, 0.5, 1.0)]
    assert np.argmax(shares) == 1 + np.sign(error)
    assert max(shares) > 0.5


def test_slices_ask_in_one_shape_at_the_given_heights(tmp_path):
    asked = []

    def sdf(points):
        asked.append(points)
        return disc(points)

    save_slices(tmp_path / "a.png", sdf, None, BOUNDS, [0.25, 0.75])
    assert {points.shape for points in asked} == {(slices._CHUNK, 3)}
    points = np.concatenate(asked)
    assert set(points[:, 2].tolist()) == {0.25, 0.75}
    for axis in (0, 1):
        low, high = points[:, axis].min(), points[:, axis].max()
        assert BOUNDS[0][axis] < low < BOUNDS[0][axis] + 0.02
        assert BOUNDS[1][axis] - 0.02 < high < BOUNDS[1][axis]


def test_what_was_not_observed_is_grey_and_the_path_green(tmp_path):
    def green_columns(image):
        green = (image[..., 1] > image[..., 0] + 0.3) & (image[..., 1] > image[..., 2] + 0.3)
        return green.any(axis=0).mean()

    save_slices(tmp_path / "a.png", disc, None, BOUNDS, [0.5])
    plain = imread(tmp_path / "a.png")

    def seen(points):
        return (points[:, 0] < 0) | (points[:, 1] < 0)

    path_world = np.array([[-1.5, -0.5, 0.5], [1.5, 0.7, 0.5]])
    save_slices(tmp_path / "b.png", disc, None, BOUNDS, [0.5], path_world, seen)
    drawn = imread(tmp_path / "b.png")
    grey = (0.78, 0.78, 0.78)
    assert share_of(plain, grey) < 0.01
    assert 0.08 < share_of(drawn, grey) < 0.3
    top, bottom = np.array_split(drawn, 2)
    left, right = np.array_split(top, 2, axis=1)
    assert share_of(right, grey) > 20 * max(share_of(left, grey), share_of(bottom, grey))
    assert green_columns(plain) == 0
    assert green_columns(drawn) > 0.5  # from x = -1.5 to 1.5 of 4 m


def test_zeros_that_nobody_saw_are_not_drawn(tmp_path):
    def black(image):
        return (image[..., :3].max(axis=-1) < 0.2).sum()

    def nothing(points):
        return np.full(len(points), False)

    def shell(points):
        return np.abs(disc(points)) < 0.05

    save_slices(tmp_path / "a.png", disc, None, BOUNDS, [0.5], observed=nothing)
    save_slices(tmp_path / "b.png", disc, None, BOUNDS, [0.5], observed=shell)
    save_slices(tmp_path / "c.png", lambda p: disc(p) + 9, None, BOUNDS, [0.5], observed=nothing)
    unseen, seen, none = (black(imread(tmp_path / name)) for name in ("a.png", "b.png", "c.png"))
    assert abs(unseen - none) < 50 < 200 < seen - none


@pytest.mark.filterwarnings("error")
def test_nothing_observed_still_makes_a_picture(tmp_path):
    save_slices(
        tmp_path / "a.png", disc, disc, BOUNDS, [0.5], observed=lambda p: np.full(len(p), False)
    )
    assert share_of(imread(tmp_path / "a.png"), (0.78, 0.78, 0.78)) > 0.3


def test_slices_misuse_is_named(tmp_path):
    with pytest.raises(ValueError, match="heights is empty"):
        save_slices(tmp_path / "a.png", disc, None, BOUNDS, [])
    with pytest.raises(ValueError, match="bounds = "):
        save_slices(tmp_path / "a.png", disc, None, BOUNDS[::-1], [0.5])
    with pytest.raises(ValueError, match="sdf answered shape"):
        save_slices(tmp_path / "a.png", lambda p: p, None, BOUNDS, [0.5])


def test_a_robot_needs_none_of_the_drawing_libraries():
    code = """
import sys
for name in ("matplotlib", "trimesh", "skimage", "tqdm"):
    sys.modules[name] = None  # importing it raises ImportError
import hiosdf_jax, hiosdf_jax.datasets, hiosdf_jax.evaluation, hiosdf_jax.mesh
import hiosdf_jax.sensors, hiosdf_jax.view
"""
    subprocess.run([sys.executable, "-c", code], check=True)


def test_small_pieces_near_the_top_are_a_ceilings_remains():
    square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    # A floor, a small piece high up, a small one low down (a chair's seat), a large one high up.
    places = np.array([[0, 0, 0], [2, 2, 2.4], [5, 5, 0.5], [0, 0, 2.5]])
    pieces = [edge * square + place for edge, place in zip((10, 1, 1, 5), places, strict=True)]
    vertices = np.concatenate(pieces)
    faces = np.array([[4 * k, 4 * k + i, 4 * k + i + 1] for k in range(4) for i in (1, 2)])
    area = np.repeat([50.0, 0.5, 0.5, 12.5], 2)
    remains = shading._remains_of_ceiling(vertices[:, 2], faces, area)
    assert remains.tolist() == [False] * 2 + [True] * 2 + [False] * 4
