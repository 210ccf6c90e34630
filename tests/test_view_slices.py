"""Slices of analytic distances, by the colors of the picture."""

import numpy as np
import pytest
import trimesh
from matplotlib import colormaps
from matplotlib.image import imread

from hiosdf_jax._src.view import slices
from hiosdf_jax.pictures import save_slices

BOUNDS = ((-2.0, -1.0, 0.0), (2.0, 1.0, 1.0))


def disk(points):
    return np.linalg.norm(points[:, :2], axis=-1) - 0.5


def share_of(image, color):
    return (np.abs(image[..., :3] - np.array(color[:3])).max(axis=-1) < 0.02).mean()


def test_errors_show_their_sign(tmp_path):
    errors = {0.2: -0.2, 0.5: 0.0, 0.8: 0.2}

    def wrong(points):
        return disk(points) + np.interp(points[:, 2], list(errors), list(errors.values()))

    save_slices(tmp_path / "slices.png", wrong, disk, BOUNDS, list(errors))
    image = imread(tmp_path / "slices.png")
    column = image[:, 2 * image.shape[1] // 3 :][: int(0.85 * image.shape[0])]  # the errors
    scale = colormaps["PuOr_r"]
    for row, error in zip(np.array_split(column, 3), errors.values(), strict=True):
        shares = [share_of(row, scale(value)) for value in (0.0, 0.5, 1.0)]
        assert np.argmax(shares) == 1 + np.sign(error)
        assert max(shares) > 0.5


def test_queries_have_one_shape_and_the_given_heights(tmp_path):
    asked = []

    def sdf(points):
        asked.append(points)
        return disk(points)

    save_slices(tmp_path / "a.png", sdf, None, BOUNDS, [0.25, 0.75])
    assert {points.shape for points in asked} == {(slices.CHUNK, 3)}
    points = np.concatenate(asked)
    assert set(points[:, 2].tolist()) == {0.25, 0.75}
    for axis in (0, 1):
        low, high = points[:, axis].min(), points[:, axis].max()
        assert BOUNDS[0][axis] < low < BOUNDS[0][axis] + 0.02
        assert BOUNDS[1][axis] - 0.02 < high < BOUNDS[1][axis]


def test_unobserved_space_is_gray_and_the_path_green(tmp_path):
    def green_columns(image):
        green = (image[..., 1] > image[..., 0] + 0.3) & (image[..., 1] > image[..., 2] + 0.3)
        return green.any(axis=0).mean()

    save_slices(tmp_path / "a.png", disk, None, BOUNDS, [0.5])
    plain = imread(tmp_path / "a.png")

    def seen(points):
        return (points[:, 0] < 0) | (points[:, 1] < 0)

    path_world = np.array([[-1.5, -0.5, 0.5], [1.5, 0.7, 0.5]])
    save_slices(tmp_path / "b.png", disk, None, BOUNDS, [0.5], path_world, seen)
    drawn = imread(tmp_path / "b.png")
    gray = (0.78, 0.78, 0.78)
    assert share_of(plain, gray) < 0.01
    assert 0.08 < share_of(drawn, gray) < 0.3
    top, bottom = np.array_split(drawn, 2)
    left, right = np.array_split(top, 2, axis=1)
    assert share_of(right, gray) > 20 * max(share_of(left, gray), share_of(bottom, gray))
    assert green_columns(plain) == 0
    assert green_columns(drawn) > 0.5  # from x = -1.5 to 1.5 of 4 m


def test_zeros_in_unobserved_space_are_not_drawn(tmp_path):
    def black(image):
        return (image[..., :3].max(axis=-1) < 0.2).sum()

    def nothing(points):
        return np.full(len(points), False)

    def shell(points):
        return np.abs(disk(points)) < 0.05

    save_slices(tmp_path / "a.png", disk, None, BOUNDS, [0.5], observed=nothing)
    save_slices(tmp_path / "b.png", disk, None, BOUNDS, [0.5], observed=shell)
    save_slices(tmp_path / "c.png", lambda p: disk(p) + 9, None, BOUNDS, [0.5], observed=nothing)
    unseen, seen, none = (black(imread(tmp_path / name)) for name in ("a.png", "b.png", "c.png"))
    assert abs(unseen - none) < 50 < 200 < seen - none


@pytest.mark.filterwarnings("error")
def test_a_map_without_observed_space_is_drawn(tmp_path):
    save_slices(
        tmp_path / "a.png", disk, disk, BOUNDS, [0.5], observed=lambda p: np.full(len(p), False)
    )
    assert share_of(imread(tmp_path / "a.png"), (0.78, 0.78, 0.78)) > 0.3


def test_messages_name_the_wrong_argument(tmp_path):
    with pytest.raises(ValueError, match="heights is empty"):
        save_slices(tmp_path / "a.png", disk, None, BOUNDS, [])
    with pytest.raises(ValueError, match="bounds = "):
        save_slices(tmp_path / "a.png", disk, None, BOUNDS[::-1], [0.5])
    with pytest.raises(ValueError, match=r"sdf has shape \(16384, 3\)"):
        save_slices(tmp_path / "a.png", lambda p: p, None, BOUNDS, [0.5])


def test_the_surface_of_a_mesh_is_drawn_where_it_is_cut(tmp_path):
    cube = trimesh.creation.box((1.0, 0.8, 1.0))
    lines = np.stack(slices._section(cube, 0.3).get_segments())
    on_x, on_y = (
        np.isclose(np.abs(lines[..., axis]), half).all(axis=1)
        for axis, half in ((0, 0.5), (1, 0.4))
    )
    assert (on_x | on_y).all()
    assert np.linalg.norm(np.diff(lines, axis=1), axis=-1).sum() == pytest.approx(3.6)
    assert not slices._section(cube, 0.7).get_segments()

    def far(points):
        return np.full(len(points), 5.0)

    drawn = {}
    for name, mesh in (("without", None), ("with", cube)):
        save_slices(tmp_path / f"{name}.png", far, None, BOUNDS, [0.3], mesh=mesh)
        drawn[name] = imread(tmp_path / f"{name}.png")[..., :3].max(axis=-1) < 0.3
    assert drawn["with"].sum() > drawn["without"].sum() + 100
