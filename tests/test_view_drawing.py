"""How a finished map is leveled and cut; test_command_map_stream.py checks the pictures."""

import numpy as np
import pytest
import trimesh
from matplotlib.axes import Axes

from hiosdf_jax._src.view import drawing
from hiosdf_jax._src.view.leveling import world_from_level
from hiosdf_jax._src.view.paths import save_paths


def test_heights_of_the_slices():
    assert drawing.slice_heights(1.2, 0.0, 2.6) == [0.6, 1.2]
    assert drawing.slice_heights(1.0, 0.0, 9.0) == [0.5, 1.0, 5.0]
    assert drawing.slice_heights(0.3, 0.0, 1.0) == [0.3]


def test_floors_give_the_direction_up():
    room = trimesh.creation.box([2.4, 2, 1.6])
    room.invert()  # free space is inside
    turn = trimesh.transformations.rotation_matrix(0.4, [1, 2, 0])
    room.apply_transform(turn)
    up = turn[:3, 2]
    guess = up + np.array([0.3, -0.1, 0.1])
    np.testing.assert_allclose(drawing.level_up(room, guess / np.linalg.norm(guess)), up, atol=1e-6)
    np.testing.assert_array_equal(drawing.level_up(trimesh.Trimesh(), up), up)


def test_a_map_without_surface_writes_no_mesh(tmp_path, capsys):
    drawing._write_mesh(tmp_path, trimesh.Trimesh(), np.array([0.0, 0, 1]))
    assert not list(tmp_path.iterdir())
    assert "no surface" in capsys.readouterr().out


@pytest.mark.parametrize("up", [[0, 0, 1], [0, -1, 0], [0.6, 0, -0.8], [0, 0, -1]])
def test_the_turn_maps_z_to_up(up):
    turn = world_from_level(np.array(up, float))
    np.testing.assert_allclose(turn @ [0, 0, 1], up, atol=1e-12)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)


def test_a_world_that_is_tilted_by_a_degree_is_drawn_as_it_is():
    up = np.array([0, np.sin(np.radians(1)), np.cos(np.radians(1))])
    np.testing.assert_array_equal(world_from_level(up), np.eye(3))
    assert not np.array_equal(world_from_level(np.array([0, 0.1, 0.995])), np.eye(3))


@pytest.mark.parametrize("up", [[0, 0, 1], [0, 0, -1], [-0.01, -0.894, -0.447]])
def test_a_path_is_drawn_from_above_and_not_mirrored(tmp_path, monkeypatch, up):
    """A sensor that turns left about the vertical turns left in the picture."""
    up = np.array(up) / np.linalg.norm(up)
    first = np.cross(up, [1.0, 0.2, 0.1])
    ways = np.stack([first, np.cross(up, first)])  # the second one is to the left
    path = np.cumsum(np.vstack([np.zeros(3), ways]), axis=0)
    drawn, plot = [], Axes.plot

    def note(self, *values, **options):
        drawn.append(values)
        return plot(self, *values, **options)

    monkeypatch.setattr(Axes, "plot", note)
    save_paths(tmp_path / "path.png", path, path, np.ones(3, bool), np.ones(3), up)
    (x, y) = (np.diff(values) for values in drawn[0])
    assert x[0] * y[1] - x[1] * y[0] > 0


def test_a_path_without_given_poses_is_drawn_alone(tmp_path, monkeypatch):
    labels, plot = [], Axes.plot

    def note(self, *values, **options):
        labels.append(options["label"])
        return plot(self, *values, **options)

    monkeypatch.setattr(Axes, "plot", note)
    path, up = np.arange(9.0).reshape(3, 3), np.array([0, 0, 1.0])
    save_paths(tmp_path / "path.png", None, path, np.ones(3, bool), np.ones(3), up)
    assert labels == ["registered in the map", "start", "standard deviation in the map"]
