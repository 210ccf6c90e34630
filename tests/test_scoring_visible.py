"""Points drawn from a stream against closed forms and against recorded exact distances."""

from pathlib import Path

import numpy as np
import pytest
from pole_room import HALF, POLE, box_sdf, room_mesh, room_sdf, room_stream, slopes, write_grid
from scipy.spatial import cKDTree

pytest.importorskip("igl")

from hiosdf_jax._src.scoring.scene import grid_scene
from hiosdf_jax.datasets import FrameStream, NpzStream, read_truth
from hiosdf_jax.scoring import mesh_scene, read_rays, read_scene, sample_visible, sensor_path

SHARED = Path(__file__).parents[2] / "shared" / "data"


def test_sampled_points_were_observed_and_are_exact():
    rays = read_rays(room_stream())
    truth = sample_visible(mesh_scene(room_mesh(), sensor_path(rays)), rays, count=4000)
    assert [len(field) for field in truth[:5]] == [4000] * 5
    names = ["float32"] * 3 + ["int32", "float32", "float32"]
    assert [field.dtype.name for field in truth] == names
    np.testing.assert_allclose(truth.sdf, room_sdf(truth.points_world), atol=1e-6)
    assert truth.sdf.min() >= 0
    away = np.abs(truth.sdf) > 0.01
    unit = np.linalg.norm(truth.grad, axis=-1)
    np.testing.assert_allclose(unit, 1, atol=1e-6)
    slope = slopes(room_sdf, truth.points_world[away].astype(float))
    aligned = (slope * truth.grad[away]).sum(axis=-1)
    assert np.quantile(aligned, 0.02) > 0.999  # except on the creases between two walls
    assert np.abs(room_sdf(truth.surface_points_world)).max() < 1e-6  # exact, whatever the noise
    np.testing.assert_allclose(np.bincount(truth.frame) / 4000, 1 / 6, atol=0.03)
    # The position on a ray is uniform between sensor and surface.
    sensor = np.stack([-0.5 + 0.1 * truth.frame, np.full(4000, -0.2), np.full(4000, 0.1)], axis=-1)
    lines = truth.points_world - sensor
    length = np.linalg.norm(lines, axis=-1)
    whole = np.zeros(4000)
    for _ in range(200):
        whole += room_sdf(sensor + whole[:, None] * lines / length[:, None])
    assert (length < whole + 1e-4).all()
    assert (length / whole).mean() == pytest.approx(0.5, abs=0.02)
    thin = truth.thin_points_world
    assert len(thin) == 50
    np.testing.assert_allclose(np.abs(thin[:, :2] - POLE).max(axis=-1), 0.015, atol=1e-6)
    again = sample_visible(mesh_scene(room_mesh(), sensor_path(rays)), rays, count=4000)
    np.testing.assert_array_equal(again.points_world, truth.points_world)


def test_returns_from_missing_objects_are_left_out():
    """The stream has a pole that the scene does not contain."""
    rays = read_rays(room_stream())
    truth = sample_visible(mesh_scene(room_mesh(pole=False), sensor_path(rays)), rays, count=3000)
    shadow = truth.surface_points_world[:, 0] > 1.9
    frame = rays.frame == 2
    ends = rays.origin_world[frame] + rays.range[frame, None] * rays.direction_world[frame]
    assert (np.abs(ends[:, :2] - POLE).max(axis=-1) < 0.05).sum() > 20
    assert shadow.any() and len(truth.thin_points_world) == 0
    np.testing.assert_allclose(truth.sdf, -box_sdf(truth.points_world, HALF), atol=1e-6)


def test_a_scene_in_another_frame_is_refused():
    rays = read_rays(room_stream())
    mesh = room_mesh()
    mesh.apply_scale(1000)  # millimeters
    with pytest.raises(ValueError, match=r"only 0% of the stream's returns lie within 0\.2 m"):
        sample_visible(mesh_scene(mesh, sensor_path(rays)), rays)


def test_a_grid_scores_a_stream(tmp_path):
    rays = read_rays(room_stream())

    def in_hole(points):  # in the middle of the room
        return (np.abs(points[:, 0] - 0.2) < 0.2) & (points[:, 1] > 0.15)

    def holed(points):  # iSDF's mark for no data
        hole = (np.abs(points[..., 0] - 0.2) < 0.2) & (points[..., 1] > 0.15)
        return np.where(hole, 0, room_sdf(points))

    write_grid(tmp_path, holed, spacing=0.03)
    truth = sample_visible(grid_scene(tmp_path), rays, count=3000)
    assert 2000 < len(truth.sdf) < 2950  # the samples around the hole are left out too
    assert not in_hole(truth.points_world).any()
    # A pole thinner than two grid steps is blurred; walls are not.
    away = np.linalg.norm(truth.points_world[:, :2] - POLE, axis=-1) > 0.1
    error = np.abs(truth.sdf - room_sdf(truth.points_world))[away]
    assert error.max() < 0.015  # on creases, half a step
    assert np.quantile(error, 0.9) < 1e-3
    wall = np.linalg.norm(truth.surface_points_world[:, :2] - POLE, axis=-1) > 0.3
    error = np.abs(room_sdf(truth.surface_points_world[wall]))
    assert np.quantile(error, 0.95) < 1e-3 and len(truth.thin_points_world) == 0


def test_bad_frames_and_far_returns_are_left_out():
    good = room_stream()

    def read(index):
        cloud, pose = good[index]
        cloud = cloud.copy()
        if index == 1:
            pose = pose * np.nan
        if index == 2:
            cloud = cloud * np.nan
        cloud[:5] = np.nan
        cloud[5] = 0
        return cloud, pose

    rays = read_rays(FrameStream("room", 3, read), max_range=1.5)
    assert {*rays.frame} == {0}
    cloud, pose = good[0]
    lengths = np.linalg.norm(cloud[6:], axis=-1)
    assert len(rays.range) == (lengths <= 1.5).sum() < len(lengths)
    ends = rays.origin_world + rays.range[:, None] * rays.direction_world
    expected = cloud[6:][lengths <= 1.5] + pose[:3, 3]
    np.testing.assert_allclose(ends, expected, atol=1e-5)
    with pytest.raises(ValueError, match=r"none of the 3 frames has a return within 0\.01 m"):
        read_rays(FrameStream("room", 3, read), max_range=0.01)


@pytest.mark.skipif(not SHARED.exists(), reason="needs ../shared/data")
def test_recorded_distances_are_those_of_the_mesh():
    truth = read_truth(SHARED / "house_depth.npz")
    scene = read_scene(
        SHARED / "small_house.ply", np.load(SHARED / "house_depth.npz")["poses"][:, :3, 3]
    )
    chosen = np.random.default_rng(0).choice(len(truth.sdf), 3000, replace=False)
    sdf, grad = scene.sdf_and_grad(truth.points_world[chosen])
    np.testing.assert_allclose(np.abs(sdf), truth.sdf[chosen], atol=2e-6)
    aligned = np.sign(sdf) * (grad * truth.grad[chosen]).sum(axis=-1)
    assert np.quantile(aligned, 0.001) > 0.999
    assert (sdf < 0).mean() < 0.001  # all were observed; 32 of 120 positions observe nearly all
    # Sampled again from the stream, with other random numbers, the same kind of points.
    stream = NpzStream(SHARED / "house_depth.npz")
    rays = read_rays(FrameStream("part", 8, lambda i: stream[15 * i]), max_range=6.0)
    drawn = sample_visible(scene, rays, count=2000)
    subset = np.isin(truth.frame, 15 * np.arange(8))
    assert drawn.sdf.mean() == pytest.approx(truth.sdf[subset].mean(), rel=0.1)
    near = cKDTree(truth.surface_points_world).query(drawn.surface_points_world)[0]
    assert np.median(near) < 0.1
