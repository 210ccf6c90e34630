"""The worlds and sensors of the robustness benchmark against oracles."""

import mujoco
import numpy as np
import pytest

from benchmarks.robustness import apartment, movers, scenes
from benchmarks.robustness.sensors import SENSORS, depth_camera, lidar, look_at, scan
from benchmarks.robustness.worlds import (
    BACKGROUND,
    Box,
    Capsule,
    Room,
    World,
    bounding_box,
    draw_inside,
    thing_distance,
)

THINGS = (
    Box((1.0, 0.4, 0.2), (0.3, 0.5, 0.4), 0.6),
    Box((-1.2, 0.3, -0.4), (0.2, 0.2, 0.9)),
    Capsule((0.0, -1.5, -0.5), (0.4, -1.1, 0.9), 0.25),
    Capsule((-0.5, 1.6, 0.0), (-0.5, 1.6, 0.0), 0.3),
)
WORLD = World(Room((-2.0, -2.5, -1.5), (2.5, 2.0, 1.5)), THINGS)


@pytest.fixture(scope="module")
def model():
    """The things of WORLD in MuJoCo."""
    geoms = []
    for thing in THINGS:
        if isinstance(thing, Box):
            place = f'pos="{_text(thing.center)}" euler="0 0 {thing.yaw}"'
            geoms.append(f'<geom type="box" size="{_text(thing.half)}" {place}/>')
        elif thing.start == thing.end:
            geoms.append(f'<geom type="sphere" size="{thing.radius}" pos="{_text(thing.start)}"/>')
        else:
            ends = _text((*thing.start, *thing.end))
            geoms.append(f'<geom type="capsule" size="{thing.radius}" fromto="{ends}"/>')
    xml = f"""<mujoco><compiler angle="radian"/>
      <worldbody>{"".join(geoms)}</worldbody></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def _text(values):
    return " ".join(map(str, values))


def _directions(count, seed=0):
    rays = np.random.default_rng(seed).normal(size=(count, 3))
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def test_rays_hit_where_those_of_mujoco_do(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    directions = _directions(4000)
    count = len(directions)
    for origin in ([0.1, 0.2, 0.3], [2.0, -2.0, 1.0], [-1.9, 1.9, -1.4]):
        ranges, geoms = np.empty(count), np.empty(count, np.int32)
        for k, direction in enumerate(directions):
            ranges[k] = mujoco.mj_ray(
                model, data, np.array(origin), direction, None, 1, -1, geoms[k : k + 1]
            )
        mine, hit = WORLD.cast(np.array(origin), directions)
        np.testing.assert_array_equal(hit, geoms)
        assert (hit == BACKGROUND).any() and len(np.unique(hit)) >= 4
        np.testing.assert_allclose(mine[hit >= 0], ranges[hit >= 0], atol=1e-9)


def test_rays_that_miss_all_things_end_on_the_walls():
    directions = _directions(500)
    origin = np.array([0.1, 0.2, 0.3])
    ranges, hit = World(WORLD.background).cast(origin, directions)
    assert (hit == BACKGROUND).all()
    ends = origin + ranges[:, None] * directions
    np.testing.assert_allclose(WORLD.background.distance(ends), 0, atol=1e-12)


def test_rays_along_the_axes_hit_faces():
    world = World(Room((-1, -1, -1), (3, 1, 1)), (Box((2, 0, 0), (0.5, 0.5, 0.5)),))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    ranges, hit = world.cast(np.zeros(3), axes)
    np.testing.assert_allclose(ranges, [1.5, 1, 1, 1, 1, 1])
    np.testing.assert_array_equal(hit == 0, [True, False, False, False, False, False])


def test_distances_are_those_to_the_nearest_of_many_surface_points():
    """Rays from a point in all directions find no surface nearer than the distance."""
    directions = _directions(20_000)
    points = np.random.default_rng(1).uniform((-2, -2.5, -1.5), (2.5, 2, 1.5), (60, 3))
    points = points[WORLD.distance(points) > 0.02]
    assert len(points) > 30
    for point in points:
        distance = WORLD.distance(point[None])[0]
        least = WORLD.cast(point, directions)[0].min()
        assert distance - 1e-9 <= least <= 1.04 * distance + 0.002


def test_distances_inside_things_are_exact():
    """From inside, the surface is where the distance to the thing alone changes its sign."""
    rng = np.random.default_rng(2)
    for thing in THINGS:
        surface = _surface(thing, rng)
        inside = draw_inside(thing, 50, 0.01, rng)
        nearest = np.linalg.norm(inside[:, None] - surface, axis=-1).min(axis=1)
        np.testing.assert_allclose(-thing_distance(thing, inside), nearest, atol=0.02)


def _surface(thing, rng):
    """Points on the surface, by bisection from its center outward."""
    low, high = bounding_box(thing)
    center = (low + high) / 2
    directions = _directions(20_000)
    near, far = np.zeros(len(directions)), np.full(len(directions), 3.0)
    for _ in range(40):
        middle = (near + far) / 2
        inside = thing_distance(thing, center + middle[:, None] * directions) < 0
        near, far = np.where(inside, middle, near), np.where(inside, far, middle)
    return center + near[:, None] * directions


def test_points_drawn_inside_are_as_deep_as_asked():
    for thing in THINGS:
        points = draw_inside(thing, 300, 0.1, np.random.default_rng(0))
        assert points.shape == (300, 3)
        assert thing_distance(thing, points).max() <= -0.1
        low, high = bounding_box(thing)
        assert (points >= low).all() and (points <= high).all()


@pytest.mark.parametrize("name", SENSORS)
def test_scans_are_functions_of_their_seed_and_noise_is_as_said(name):
    sensor = SENSORS[name]()
    pose = look_at(np.array([1.4, 2.4, 0.9]), np.array([3.8, 2.5, 0.9]), sensor)
    world = World(scenes.ROOM, (Box((3.8, 2.5, 0.6), (0.25, 0.3, 0.6)),))
    first, again, other = (
        scan(sensor, world, pose, np.random.default_rng(seed)) for seed in (0, 0, 1)
    )
    np.testing.assert_array_equal(first.cloud, again.cloud)
    assert not np.array_equal(first.cloud, other.cloud, equal_nan=True)
    np.testing.assert_allclose(world.distance(first.exact_world), 0, atol=1e-9)
    assert np.count_nonzero(first.hit == 0) > 100
    returned = np.isfinite(first.cloud).all(axis=1)
    assert 0.99 < returned.mean() < 1
    in_world = first.cloud[returned] @ pose[:3, :3].T + pose[:3, 3]
    off = np.linalg.norm(in_world - first.exact_world[returned], axis=1)
    ranges = np.linalg.norm(first.cloud[returned], axis=1)
    assert off.max() < 6 * sensor.sigma(ranges).max() * 1.8
    assert off.mean() > 0.3 * sensor.sigma(ranges * sensor.forward[returned]).mean()


def test_sensors_face_their_target():
    for sensor, axis in ((depth_camera(), 2), (lidar(), 0)):
        pose = look_at(np.array([1.0, 2.0, 0.9]), np.array([3.0, 1.0, 0.9]), sensor)
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        assert np.linalg.det(pose[:3, :3]) == pytest.approx(1)
        np.testing.assert_allclose(pose[:3, axis], np.array([2, -1, 0]) / np.sqrt(5))
        down = pose[2, 1] if axis == 2 else -pose[2, 2]
        assert down == pytest.approx(-1)


def test_sensors_and_arm_stay_in_free_space():
    camera = depth_camera()
    static = World(scenes.ROOM, (movers._POST,))
    for k in range(60):
        tour = scenes.touring_path(camera, k)
        assert scenes.ROOM.distance(tour[None, :3, 3])[0] > 0.3
        pose = scenes.facing_path(camera, k)
        assert static.distance(pose[None, :3, 3])[0] > 0.3
    nearest = []
    rng = np.random.default_rng(0)
    for k in range(movers._ARM_SCANS):
        pose = scenes.facing_path(camera, k)
        parts = movers.arm_at(k, pose)
        centers, radii = movers.spheres_of(parts)
        for part in parts:
            inside = draw_inside(part, 300, 0.0, rng)
            reach = np.linalg.norm(inside[:, None] - centers, axis=-1) - radii
            assert reach.min(axis=1).max() < 0  # the spheres cover the arm
            assert thing_distance(part, pose[None, :3, 3])[0] > 0.15
        nearest.append((static.distance(centers) - radii).min())
    assert 0.02 < min(nearest) < 0.12  # it comes near the post and never touches it


def test_the_apartment_is_the_demos_and_its_things_move():
    home = apartment.Apartment()
    directions = _directions(200)
    origin = np.array([1.8, 1.5, 1.2])
    ends = origin + home.cast(origin, directions)[:, None] * directions
    np.testing.assert_allclose(home.distance(ends), 0, atol=1e-6)
    before = apartment.world_at(home, apartment._CHAIR_MOVES - 1)
    after = apartment.world_at(home, apartment._DOOR_OPENS.stop)
    middle_of_doorway = np.array([[5.65, 1.325, 1.0]])
    assert before.distance(middle_of_doorway)[0] < 0
    assert after.distance(middle_of_doorway)[0] > 0.35
    assert before.things[1] != after.things[1]
    for k in apartment._WALK:
        person = apartment.person_at(k)
        assert home.distance(draw_inside(person, 200, 0.01, np.random.default_rng(0))).min() > 0
