"""The animated GIF of a growing map, by what its frames show."""

import numpy as np
import trimesh
from PIL import Image, ImageSequence

from hiosdf_jax._src.view import shading
from hiosdf_jax._src.view.growing import MapSoFar, save_growing

UP = np.array([0.0, 0, 1])


def room(length):
    """A box of 6 m x 4 m with its faces inwards, of which `length` m along x are known."""
    walls = trimesh.creation.box(bounds=[[0, 0, 0], [length, 4, 2.5]]).subdivide_to_size(0.3)
    walls.invert()
    return walls


def frames_of(path):
    with Image.open(path) as animation:
        return [np.asarray(each.convert("RGB"), int) for each in ImageSequence.Iterator(animation)]


def test_what_is_known_grows_and_stays_in_place(tmp_path):
    path_world = np.array([[0.5, 2, 1], [2, 2, 1], [4, 3, 1]])
    maps = [MapSoFar(room(2.5), path_world[:2]), MapSoFar(room(6), path_world)]
    save_growing(tmp_path / "growing.gif", maps, UP)
    half, whole = frames_of(tmp_path / "growing.gif")
    shown = [(frame.min(axis=-1) < 250) for frame in (half, whole)]
    assert 0.2 < shown[0].sum() / shown[1].sum() < 0.7
    assert not (shown[0] & ~shown[1]).any()
    view = shading.viewpoint(maps[-1].mesh, (640, 480), UP)
    for frame, known in ((half, 2), (whole, 3)):
        column, row = np.rint(view.pixels(path_world[known - 1])).astype(int)
        assert (frame[row, column] == (204, 60, 160)).all()  # the dot of the sensor
    column, row = np.rint(view.pixels(path_world[2])).astype(int)
    assert (half[row, column] > 250).all()  # neither the room nor the sensor has been there


def test_a_map_that_was_larger_before_is_cut_at_the_edge(tmp_path):
    maps = [MapSoFar(room(6), np.zeros((1, 3))), MapSoFar(room(2), np.zeros((2, 3)))]
    save_growing(tmp_path / "growing.gif", maps, UP)
    large, small = frames_of(tmp_path / "growing.gif")
    assert large.shape == small.shape


def test_a_map_without_surface_has_no_picture(tmp_path):
    save_growing(tmp_path / "growing.gif", [MapSoFar(trimesh.Trimesh(), np.zeros((1, 3)))], UP)
    assert not list(tmp_path.iterdir())


def test_a_first_map_without_surface_is_white(tmp_path):
    maps = [MapSoFar(trimesh.Trimesh(), np.zeros((1, 3))), MapSoFar(room(3), np.ones((2, 3)))]
    save_growing(tmp_path / "growing.gif", maps, UP)
    first, _ = frames_of(tmp_path / "growing.gif")
    assert (first.min(axis=-1) > 250).mean() > 0.99
