"""Exact distances of meshes and grids against closed forms; what is drawn from a stream by them."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

pytest.importorskip("igl")

from hiosdf_jax._src.scoring.visible import (
    Rays,
    grid_scene,
    mesh_scene,
    read_rays,
    read_scene,
    sample_visible,
    sensor_path,
)
from hiosdf_jax.datasets import FrameStream, NpzStream
from hiosdf_jax.datasets import ground_truth as recorded_truth

SHARED = Path(__file__).parents[2] / "shared" / "data"
HALF = np.array([2.0, 1.5, 1.2])  # of a room around the origin
POLE = np.array([0.8, 0.3])  # x, y of a pole 3 cm thick, from floor to ceiling
ORIGIN = np.zeros((1, 3))


def box_sdf(points, half):
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def room_sdf(points):
    return np.minimum(
        -box_sdf(points, HALF), box_sdf(points - [*POLE, 0], np.array([0.015, 0.015, HALF[2]]))
    )


def room_mesh(pole=True):
    """A room, seen from within: inside out, so that the solid is around it."""
    room = trimesh.creation.box(2 * HALF)
    room.invert()
    stand = trimesh.creation.box([0.03, 0.03, 2 * HALF[2]])
    stand.apply_translation([*POLE, 0])
    return trimesh.util.concatenate([room, stand]) if pole else room


@cache
def room_stream(frames=6, noise=0.005):
    """A LiDAR in the room; its ranges by marching along the closed form."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(3000, 3))
    directions[:600] = [*POLE, 0] + rng.normal(size=(600, 3)) * [0.05, 0.05, 0.6]  # to the pole
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)

    @cache
    def read(index):
        pose = np.eye(4)
        pose[:3, 3] = [-0.5 + 0.1 * index, -0.2, 0.1]
        length = np.zeros(len(directions))
        for _ in range(200):
            length += room_sdf(pose[:3, 3] + length[:, None] * directions)
        length += noise * np.random.default_rng(index).normal(size=len(length))
        return length[:, None] * directions, pose

    return FrameStream("room", frames, read)


def points_in(low, high, count=2000, seed=0):
    return np.random.default_rng(seed).uniform(low, high, (count, 3))


def slopes(sdf, points, step=1e-5):
    steps = np.eye(3) * step
    return np.stack([(sdf(points + e) - sdf(points - e)) / (2 * step) for e in steps], axis=-1)


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


def test_bodies_that_overlap_are_one_solid():
    """Where a normal alone would say "outside", in the wall that both share."""
    left, right = trimesh.creation.box([1, 1, 1]), trimesh.creation.box([1, 1, 1])
    right.apply_translation([0.6, 0, 0])
    mesh = trimesh.util.concatenate([left, right])
    points = points_in([-0.9, -0.9, -0.9], [1.5, 0.9, 0.9])
    sdf, _ = mesh_scene(mesh, ORIGIN).sdf_and_grad(points)
    union = np.minimum(box_sdf(points, np.full(3, 0.5)), box_sdf(points - [0.6, 0, 0], 0.5))
    np.testing.assert_array_equal(sdf > 0, union > 0)


def test_a_sheet_is_signed_by_what_the_sensor_saw():
    wall = trimesh.Trimesh([[0, -1, -1], [0, 1, -1], [0, 1, 1], [0, -1, 1]], [[0, 1, 2], [0, 2, 3]])
    points = points_in([-1, -0.9, -0.9], [1, 0.9, 0.9])
    points = points[np.abs(points[:, 0]) > 1e-3]
    in_front = mesh_scene(wall, np.array([[1.0, 0, 0]]))
    sdf, grad = in_front.sdf_and_grad(points)
    # The shadow of the wall: what the straight line from (1, 0, 0) meets behind it.
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


def test_rays_meet_the_room_and_tell_its_thin_part():
    stream = room_stream(noise=0)
    rays = read_rays(stream)
    assert len(rays.range) == 6 * 3000 and {*rays.frame} == set(range(6))
    np.testing.assert_allclose(sensor_path(rays)[3], [-0.2, -0.2, 0.1], atol=1e-6)
    hits = mesh_scene(room_mesh(), sensor_path(rays)).cast(rays)
    grazing = np.abs(hits.range - rays.range) > 1e-4  # marching stops short along the pole
    assert grazing.mean() < 0.002
    ends = rays.origin_world + hits.range[:, None] * rays.direction_world
    on_pole = np.abs(ends[:, :2] - POLE).max(axis=-1) < 0.0151
    np.testing.assert_array_equal(hits.thin_part >= 0, on_pole)
    assert on_pole.sum() > 100
    beyond = Rays(np.zeros(1, int), np.array([[9.0, 0, 0]]), np.array([[1.0, 0, 0]]), np.ones(1))
    miss = mesh_scene(room_mesh(), ORIGIN).cast(beyond)
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
    rays = Rays(np.zeros(3, int), targets - along, along, np.ones(3))
    hits = scene.cast(rays)
    np.testing.assert_allclose(hits.range, [0.97, 0.98, 1], atol=1e-9)
    assert (hits.thin_part >= 0).tolist() == [False, True, False]


def test_points_drawn_were_seen_and_are_exact():
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
    assert np.quantile(aligned, 0.02) > 0.999  # all but on the creases between two walls
    assert np.abs(room_sdf(truth.surface_points_world)).max() < 1e-6  # exact, whatever the noise
    np.testing.assert_allclose(np.bincount(truth.frame) / 4000, 1 / 6, atol=0.03)
    # The place on a ray is uniform between sensor and surface.
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


def test_returns_that_the_mesh_does_not_have_are_left_out():
    """The pole was taken away after the scene was scanned: what was seen past it is not told."""
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
    mesh.apply_scale(1000)  # millimetres
    with pytest.raises(ValueError, match=r"only 0% of the stream's returns lie within 0\.2 m"):
        sample_visible(mesh_scene(mesh, sensor_path(rays)), rays)


def write_grid(folder, sdf, spacing=0.04, margin=0.3):
    low, high = -HALF - margin, HALF + margin
    counts = np.ceil((high - low) / spacing).astype(int) + 1
    index = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
    values = sdf(low + spacing * index)
    transform = np.diag([spacing] * 3 + [1.0])
    transform[:3, 3] = low
    np.save(folder / "sdf.npy", values)
    np.savetxt(folder / "transform.txt", transform)
    return low, high


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


def test_a_grid_scores_a_stream(tmp_path):
    rays = read_rays(room_stream())

    def in_hole(points):  # in the middle of the room
        return (np.abs(points[:, 0] - 0.2) < 0.2) & (points[:, 1] > 0.15)

    def holed(points):  # as iSDF marks what it has no data of
        hole = (np.abs(points[..., 0] - 0.2) < 0.2) & (points[..., 1] > 0.15)
        return np.where(hole, 0, room_sdf(points))

    write_grid(tmp_path, holed, spacing=0.03)
    truth = sample_visible(grid_scene(tmp_path), rays, count=3000)
    assert 2000 < len(truth.sdf) < 2950  # nor is anything told of the samples around it
    assert not in_hole(truth.points_world).any()
    # A pole thinner than two steps of the grid is blurred; walls are not.
    away = np.linalg.norm(truth.points_world[:, :2] - POLE, axis=-1) > 0.1
    error = np.abs(truth.sdf - room_sdf(truth.points_world))[away]
    assert error.max() < 0.015  # on creases, half a step
    assert np.quantile(error, 0.9) < 1e-3
    wall = np.linalg.norm(truth.surface_points_world[:, :2] - POLE, axis=-1) > 0.3
    error = np.abs(room_sdf(truth.surface_points_world[wall]))
    assert np.quantile(error, 0.95) < 1e-3 and len(truth.thin_points_world) == 0


def test_bad_frames_say_nothing_and_far_returns_are_left_out():
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


def test_bad_scenes_are_named(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_scene(tmp_path / "none.ply", ORIGIN)
    with pytest.raises(FileNotFoundError, match=r"sdf\.npy"):
        read_scene(tmp_path, ORIGIN)
    text = tmp_path / "text.ply"
    text.write_text("not a mesh")
    with pytest.raises(ValueError, match=r"text\.ply: cannot be read as a mesh"):
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
        ("1 0 0", r"transform.txt: has shape \(3,\)"),
        ("a b", "transform.txt: "),
        ("0 1 0 0\n1 0 0 0\n0 0 1 0\n0 0 0 1", "expected nothing but spacings"),
        ("-1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1", "expected nothing but spacings"),
    ):
        (tmp_path / "transform.txt").write_text(text)
        with pytest.raises(ValueError, match=message):
            grid_scene(tmp_path)


@pytest.mark.skipif(not SHARED.exists(), reason="needs ../shared/data")
def test_the_recorded_distances_are_those_of_the_mesh():
    truth = recorded_truth(SHARED / "house_depth.npz")
    scene = read_scene(
        SHARED / "small_house.ply", np.load(SHARED / "house_depth.npz")["poses"][:, :3, 3]
    )
    chosen = np.random.default_rng(0).choice(len(truth.sdf), 3000, replace=False)
    sdf, grad = scene.sdf_and_grad(truth.points_world[chosen])
    np.testing.assert_allclose(np.abs(sdf), truth.sdf[chosen], atol=2e-6)
    aligned = np.sign(sdf) * (grad * truth.grad[chosen]).sum(axis=-1)
    assert np.quantile(aligned, 0.001) > 0.999
    assert (sdf < 0).mean() < 0.001  # all were seen; 32 positions of 120 see nearly all
    # Drawn anew from the stream, with other random numbers, the same kind of points.
    stream = NpzStream(SHARED / "house_depth.npz")
    rays = read_rays(FrameStream("part", 8, lambda i: stream[15 * i]), max_range=6.0)
    drawn = sample_visible(scene, rays, count=2000)
    subset = np.isin(truth.frame, 15 * np.arange(8))
    assert drawn.sdf.mean() == pytest.approx(truth.sdf[subset].mean(), rel=0.1)
    near = cKDTree(truth.surface_points_world).query(drawn.surface_points_world)[0]
    assert np.median(near) < 0.1
