"""The built-in apartment, its camera path and stream, and the sampled truth."""

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

mujoco = pytest.importorskip("mujoco")

from hiosdf_jax.demo import (
    BOUNDS_WORLD,
    ApartmentStream,
    camera_path,
    load_model,
    sample_truth,
    signed_distance,
)

ROOMS = {  # x0, x1, y0, y1 in m
    "living": (0, 5.6, 0, 4.4),
    "kitchen": (5.7, 10, 0, 4.4),
    "hall": (7.5, 10, 4.5, 8),
    "bedroom": (3.3, 7.4, 4.5, 8),
    "study": (0, 3.2, 4.5, 8),
}
DOORS = [(5.65, 1.325), (9.375, 4.45), (7.45, 6.775), (3.25, 5.475), (1.375, 4.45)]  # m


@pytest.fixture(scope="module")
def model():
    return load_model()


@pytest.fixture(scope="module")
def clean():
    return ApartmentStream(frames=40, width=80, height=60, noise=False)


@pytest.fixture(scope="module")
def noisy():
    return ApartmentStream(frames=40)


@pytest.fixture(scope="module")
def truth(clean):
    return sample_truth(clean, count=5000)


def in_room(points, room):
    x0, x1, y0, y1 = ROOMS[room]
    x, y = points[:, 0], points[:, 1]
    return (x0 < x) & (x < x1) & (y0 < y) & (y < y1)


def to_world(cloud, pose):
    return cloud.astype(np.float64) @ pose[:3, :3].T + pose[:3, 3]


def exact_surface(stream, index):
    return stream.camera.exact_surface(stream.poses_world_sensor[index])


def exact_depth(stream, index):
    return stream.camera.exact_depth(stream.poses_world_sensor[index])


def body_name(model, geom):
    return model.body(model.geom_bodyid[geom]).name


# --- the world ---


def test_it_is_furnished(model):
    building = ("world", "slabs", "wall_", "column", "picture", "radiator_")
    names = [model.body(i).name for i in range(model.nbody)]
    furniture = [name for name in names if not name.startswith(building)]
    assert len(furniture) >= 15
    assert {"sofa", "bed", "dining_table", "fridge", "wardrobe", "desk"} <= set(furniture)


def test_the_model_is_static_and_all_geoms_have_an_exact_distance(model):
    assert model.nv == 0
    signed_distance(model, np.zeros((1, 3)))  # raises for any other type of geom


def test_exactly_the_thin_parts_are_named_thin(model):
    thin = 0
    for geom in range(model.ngeom):
        kind = mujoco.mjtGeom(int(model.geom_type[geom]))
        size = model.geom_size[geom]
        used = {"mjGEOM_BOX": size, "mjGEOM_CYLINDER": size[:2]}.get(kind.name, size[:1])
        is_thin = 2 * min(used) < 0.05
        assert is_thin == model.geom(geom).name.startswith("thin_"), body_name(model, geom)
        thin += is_thin
    assert thin >= 50


def test_nothing_floats_and_no_furniture_interpenetrates(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touch = np.eye(model.ngeom, dtype=bool)
    for a in range(model.ngeom):
        apart = np.linalg.norm(data.geom_xpos - data.geom_xpos[a], axis=1) - model.geom_rbound
        for b in np.nonzero(apart[:a] < model.geom_rbound[a])[0]:
            gap = mujoco.mj_geomDistance(model, data, a, int(b), 0.01, None)
            touch[a, b] = gap < 1e-3
            names = body_name(model, a), body_name(model, b)
            assert names[0] == names[1] or gap > -1e-3, names
    parts, label = connected_components(touch, directed=False)
    floating = {body_name(model, geom) for geom in np.nonzero(label != label[0])[0]}
    assert parts == 1, floating


def test_bounds_contain_the_walls(model):
    low, high = np.array(BOUNDS_WORLD)
    points = np.random.default_rng(0).uniform(low, high, (600, 3))
    for axis in range(3):
        points[200 * axis : 200 * axis + 100, axis] = low[axis]
        points[200 * axis + 100 : 200 * axis + 200, axis] = high[axis]
    sdf, _ = signed_distance(model, points)
    assert (sdf > 0.04).all()  # the outer faces of the walls are 5 cm inside


def test_doorways_are_open_below_their_lintels(model):
    doors = np.array(DOORS)

    def sdf_at(z):
        return signed_distance(model, np.column_stack([doors, np.full(len(doors), z)]))[0]

    np.testing.assert_allclose(sdf_at(1.0), 0.475, atol=1e-9)  # 0.95 m wide
    np.testing.assert_allclose(sdf_at(2.0), 0.05, atol=1e-9)  # 2.05 m high
    assert (sdf_at(2.3) < 0).all()


# --- the path ---


def test_path_keeps_clear_of_everything(model):
    path = camera_path(1000)[:, :3, 3]
    assert signed_distance(model, path)[0].min() >= 0.3
    for height in (0.4, 0.8):  # the person below the camera cannot walk through a table
        below = path * [1, 1, 0] + [0, 0, height]
        assert signed_distance(model, below)[0].min() >= 0.3


def test_path_visits_every_room():
    path = camera_path(80)[:, :3, 3]
    for room in ROOMS:
        assert in_room(path, room).sum() >= 5, room


def test_path_is_smooth_and_looks_slightly_down():
    poses = camera_path(80)
    rotations = poses[:, :3, :3]
    np.testing.assert_allclose(
        rotations.transpose(0, 2, 1) @ rotations, np.tile(np.eye(3), (80, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    np.testing.assert_allclose(poses[:, 2, 3], 1.2)
    assert (rotations[:, 2, 2] < -0.1).all() and (rotations[:, 2, 2] > -0.4).all()
    np.testing.assert_allclose(rotations[:, 2, 0], 0, atol=1e-12)  # x stays level
    assert (rotations[:, 2, 1] < 0).all()  # y points down
    assert np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).max() < 0.6
    turns = np.einsum("nij,nij->n", rotations[:-1], rotations[1:])
    assert np.degrees(np.arccos((turns - 1) / 2)).max() < 35


def test_path_does_not_depend_on_the_number_of_frames():
    np.testing.assert_allclose(camera_path(41)[::2], camera_path(21), atol=1e-9)
    np.testing.assert_array_equal(camera_path(1)[0], camera_path(2)[0])
    with pytest.raises(ValueError, match="frames = 0"):
        camera_path(0)


# --- the stream ---


def test_returns_lie_on_the_exact_surface_without_noise(clean):
    for index in range(0, len(clean), 4):
        exact = exact_surface(clean, index)[0]
        assert np.abs(signed_distance(clean.model, exact)[0]).max() < 1e-6
        cloud, pose = clean[index]
        seen = np.isfinite(cloud).all(axis=1)
        np.testing.assert_allclose(to_world(cloud[seen], pose), exact, atol=1e-5)


def test_rays_stop_at_the_first_surface(clean):
    for index in (3, 20, 33):
        exact = exact_surface(clean, index)[0]
        origin = clean.poses_world_sensor[index, :3, 3]
        for share in (0.25, 0.5, 0.9):
            sdf, _ = signed_distance(clean.model, origin + share * (exact - origin))
            assert (sdf > 0).all()


def test_frames_have_the_documented_shape_and_dtype(noisy):
    cloud, pose = noisy[0]
    assert cloud.shape == (160 * 120, 3) and cloud.dtype == np.float32
    assert pose.shape == (4, 4) and pose.dtype == np.float32
    missing = np.isnan(cloud)
    np.testing.assert_array_equal(missing.any(axis=1), missing.all(axis=1))


def test_field_of_view_is_90_degrees(clean):
    cloud, _ = clean[0]
    image = cloud.reshape(60, 80, 3)
    # Centers of the outermost pixels lie half a pixel inside.
    for column, x_over_z in ((0, -39.5 / 40), (-1, 39.5 / 40)):
        edge = image[:, column]
        np.testing.assert_allclose(edge[:, 0] / edge[:, 2], x_over_z, rtol=1e-5)
    bottom = image[-1]
    np.testing.assert_allclose(bottom[:, 1] / bottom[:, 2], 29.5 / 40, rtol=1e-5)


def test_returns_are_within_the_limits_of_range():
    stream = ApartmentStream(frames=20, width=40, height=30, max_range=2.0)
    for cloud, _ in stream:
        ranges = np.linalg.norm(cloud[np.isfinite(cloud[:, 0])], axis=1)
        assert ranges.min() >= 0.3 - 1e-6 and ranges.max() <= 2 + 1e-6
    short = sum(np.isnan(cloud[:, 0]).sum() for cloud, _ in stream)
    assert short > 0.1 * 20 * 40 * 30  # most of the apartment is farther away


def test_noise_follows_its_formula(noisy):
    exact = np.concatenate([exact_depth(noisy, i) for i in range(0, 40, 2)])
    cloud = np.concatenate([noisy[i][0] for i in range(0, 40, 2)])
    error, sigma = cloud[:, 2] - exact, 0.0012 + 0.0019 * (exact - 0.4) ** 2
    usable = np.linalg.norm(cloud, axis=1) < 5.5  # neither NaN nor cut at the limit
    flies = usable & (np.abs(error) > 6 * sigma)
    assert 0.0005 < flies.sum() / usable.sum() < 0.01
    for near, far in ((0.5, 1), (1, 2), (2, 3), (3, 4)):
        score = (error / sigma)[usable & ~flies & (near < exact) & (exact < far)]
        assert len(score) > 5000
        assert np.std(score) == pytest.approx(1, abs=0.03)
        assert np.mean(score) == pytest.approx(0, abs=0.04)


def test_noise_moves_points_along_their_rays(noisy):
    cloud = noisy[7][0].reshape(120, 160, 3)
    u = (np.arange(160) + 0.5 - 80) / 80
    ratio = cloud[..., 0] / cloud[..., 2]
    usable = np.isfinite(ratio)
    np.testing.assert_allclose(ratio[usable], np.broadcast_to(u, ratio.shape)[usable], rtol=1e-5)


def test_some_pixels_drop_out(noisy):
    near = np.concatenate([exact_depth(noisy, i) for i in range(40)]) < 3  # always within range
    missing = np.concatenate([np.isnan(noisy[i][0][:, 0]) for i in range(40)])
    assert missing[near].mean() == pytest.approx(0.005, abs=0.0007)


def test_flying_pixels_lie_between_foreground_and_background(noisy):
    count = 0
    for index in range(0, 40, 8):
        exact = exact_depth(noisy, index).reshape(120, 160)
        depth = noisy[index][0][:, 2].reshape(120, 160)
        sigma = 0.0012 + 0.0019 * (exact - 0.4) ** 2
        padded = np.pad(exact, 1, mode="edge")
        window = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        nearest, farthest = window.min(axis=(2, 3)), window.max(axis=(2, 3))
        flies = (np.abs(depth - exact) > 6 * sigma) & np.isfinite(depth)
        noise = 5 * (0.0012 + 0.0019 * (farthest - 0.4) ** 2)
        assert (depth > nearest - noise)[flies].all() and (depth < farthest + noise)[flies].all()
        count += flies.sum()
    assert count > 50


def test_frames_depend_on_arguments_and_index_only(noisy):
    small = {"frames": 6, "width": 40, "height": 30}
    forwards = [cloud for cloud, _ in ApartmentStream(**small)]
    again = ApartmentStream(**small)
    for index in reversed(range(6)):
        np.testing.assert_array_equal(again[index][0], forwards[index])
    other = ApartmentStream(**small, seed=1)
    assert not np.array_equal(other[0][0], forwards[0], equal_nan=True)


def test_frames_do_not_share_their_noise(noisy):
    near = (exact_depth(noisy, 0) < 3) & (exact_depth(noisy, 1) < 3)
    dropped = [np.isnan(noisy[index][0][:, 0]) & near for index in (0, 1)]
    assert dropped[0].sum() > 10
    assert (dropped[0] & dropped[1]).sum() < 0.2 * dropped[0].sum()


def test_it_is_a_sequence():
    stream = ApartmentStream(frames=3, width=8, height=6)
    assert len(stream) == 3
    assert len(list(stream)) == 3
    for index in (3, -1):
        with pytest.raises(IndexError, match=f"index = {index}"):
            stream[index]


@pytest.mark.parametrize(
    ("arguments", "match"),
    [({"frames": 0}, "frames"), ({"width": 0}, "width"), ({"max_range": 0.3}, "max_range")],
)
def test_bad_arguments_are_named(arguments, match):
    with pytest.raises(ValueError, match=match):
        ApartmentStream(**arguments)


# --- the truth ---


def test_truth_has_the_documented_shapes_and_is_exact(clean, truth):
    assert truth.points_world.shape == (5000, 3) and truth.surface_points_world.shape == (5000, 3)
    assert [field.dtype.name for field in truth] == ["float32"] * 3 + [
        "int32",
        "float32",
        "float32",
    ]
    sdf, grad = signed_distance(clean.model, truth.points_world)
    np.testing.assert_allclose(truth.sdf, sdf, atol=1e-6)
    np.testing.assert_allclose(truth.grad, grad, atol=1e-6)
    assert truth.sdf.min() > -1e-6
    surface, _ = signed_distance(clean.model, truth.surface_points_world)
    assert np.abs(surface).max() < 2e-6  # the rounding of 10 m to float32


def test_thin_points_are_seen_and_on_thin_parts(clean, truth):
    model = clean.model
    thin = [i for i in range(model.ngeom) if model.geom(i).name.startswith("thin_")]
    seen = np.zeros(model.ngeom, int)
    everything = []
    for index in range(len(clean)):
        points, geoms = exact_surface(clean, index)
        seen += np.bincount(geoms, minlength=model.ngeom)
        everything.append(points)
    expected = sum(min(seen[i], 50) for i in thin if seen[i] >= 10)
    assert 1000 < expected == len(truth.thin_points_world)
    exact = {*map(bytes, np.concatenate(everything).astype(np.float32))}
    assert all(bytes(point) in exact for point in truth.thin_points_world)
    # A ray ends on the geom that it hit.
    distance = np.stack([_distance_to(model, i, truth.thin_points_world) for i in thin])
    assert np.abs(distance).min(axis=0).max() < 1e-5


def _distance_to(model, geom, points):
    from hiosdf_jax._src.demo import primitives

    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    local = (points - data.geom_xpos[geom]) @ data.geom_xmat[geom].reshape(3, 3)
    return primitives._PRIMITIVES[int(model.geom_type[geom])][0](local, model.geom_size[geom])


def test_truth_points_are_free_in_their_frame(clean, truth):
    assert truth.frame.min() == 0 and truth.frame.max() == len(clean) - 1
    for index in range(len(clean)):
        pose = clean.poses_world_sensor[index]
        local = (truth.points_world[truth.frame == index] - pose[:3, 3]) @ pose[:3, :3]
        ahead = local[local[:, 2] > 0.05]  # nearer, rounding blurs the pixel
        column, row = (ahead[:, :2] / ahead[:, 2:] * 40 + [40, 30]).astype(int).T
        assert (ahead[:, 2] <= exact_depth(clean, index)[row * 80 + column] + 1e-5).all()


def test_truth_covers_all_rooms(truth):
    for points in (truth.points_world, truth.surface_points_world):
        for room in ROOMS:
            assert in_room(points, room).mean() > 0.03, room


def test_truth_depends_on_its_seed_only(clean, truth):
    again = sample_truth(clean, count=5000)
    noisy = ApartmentStream(frames=40, width=80, height=60)
    for other in (again, sample_truth(noisy, count=5000)):
        for got, expected in zip(other, truth, strict=True):
            np.testing.assert_array_equal(got, expected)
    assert not np.array_equal(sample_truth(clean, 5000, seed=2).points_world, truth.points_world)


def test_truth_refuses_a_frame_that_sees_nothing():
    blind = ApartmentStream(frames=2, width=8, height=6, max_range=0.31)
    with pytest.raises(ValueError, match=r"frame 0 sees no surface within 0\.31 m"):
        sample_truth(blind, count=10)
