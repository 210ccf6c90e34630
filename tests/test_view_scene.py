"""What a live view shows of a map, as arrays and colors."""

import numpy as np
import pytest
import trimesh
from room import BOUNDS, CONFIG, HALF, room_cloud, room_sdf

import hiosdf_jax as hio
from hiosdf_jax._src.field.compiled import CompiledQueries
from hiosdf_jax._src.state.pytrees import Side
from hiosdf_jax._src.view import colors, moments, scene


@pytest.fixture(scope="module")
def field(sharp_map):
    return hio.snapshot(sharp_map)


@pytest.fixture(scope="module")
def mesh(field):
    return hio.extract_mesh(field, CONFIG.voxel_size)


def test_the_surface_is_colored_by_height_along_the_vertical(mesh):
    for up in (np.array([0.0, 0.0, 1.0]), np.array([0.0, -1.0, 0.0])):
        painted, scale = scene.paint_surface(mesh, "height", up_world=up)
        heights = mesh.vertices @ up
        assert scale.low == pytest.approx(-HALF @ np.abs(up), abs=0.15)
        assert scale.high == pytest.approx(HALF @ np.abs(up), abs=0.15)
        np.testing.assert_array_equal(painted, scale.paint(heights.astype(np.float32)))


def test_the_surface_is_colored_by_its_error(mesh):
    painted, scale = scene.paint_surface(mesh, "error", room_sdf)
    errors_cm = 100 * room_sdf(np.asarray(mesh.vertices))
    assert np.abs(errors_cm).mean() < 3
    np.testing.assert_allclose(painted.astype(int), scale.paint(errors_cm).astype(int), atol=2)
    assert scale.label.endswith("[cm]")


def test_the_surface_is_colored_by_the_spread_of_its_hits(mesh):
    painted, scale = scene.paint_surface(mesh, "spread")
    spread = mesh.vertex_attributes["spread"]
    np.testing.assert_array_equal(painted, scale.paint(100 * spread))


def test_a_color_that_cannot_be_is_refused(mesh):
    with pytest.raises(ValueError, match="'error', expected height or spread"):
        scene.paint_surface(mesh, "error")
    with pytest.raises(ValueError, match="'blue', expected height, spread or error"):
        scene.paint_surface(mesh, "blue", room_sdf)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_slice_shows_the_distances_where_it_lies(field, axis):
    plane = scene.cut(CompiledQueries(field), axis, 0.1)
    rows, columns = plane.image.shape[:2]
    assert rows * columns <= 16384
    right, down = plane.right_world, plane.down_world
    assert plane.center_world[axis] == 0.1 and right[axis] == down[axis] == 0
    bounds = np.array(BOUNDS)
    np.testing.assert_allclose(np.abs(right) * plane.width_m, np.abs(right) * np.ptp(bounds, 0))
    np.testing.assert_allclose(np.abs(down) * plane.height_m, np.abs(down) * np.ptp(bounds, 0))
    rng = np.random.default_rng(axis)
    shown = 0
    for row, column in zip(rng.integers(0, rows, 300), rng.integers(0, columns, 300), strict=True):
        point = plane.center_world + right * plane.width_m * ((column + 0.5) / columns - 0.5)
        point = point + down * plane.height_m * ((row + 0.5) / rows - 0.5)
        answer = hio.query(field, point)
        color = plane.image[row, column].astype(int)
        if (color == 0).all():
            assert abs(float(answer.sdf)) < 0.03
        elif not bool(answer.observed):
            assert (color == colors.UNSEEN).all()
        else:
            expected = colors.DISTANCE.paint(float(answer.sdf)).astype(int)
            assert np.abs(color - expected).max() <= 6
            shown += 1
    assert shown > 50


def test_a_slice_has_black_walls(field):
    """Along the middle of the room, from one wall to the other."""
    plane = scene.cut(CompiledQueries(field), 2, 0.0)
    rows, columns = plane.image.shape[:2]
    black = (plane.image[rows // 2 - 3 : rows // 2 + 3] == 0).all(axis=-1).any(axis=0)
    x = BOUNDS[0][0] + (np.flatnonzero(black) + 0.5) * plane.width_m / columns
    assert len(x) and np.abs(np.abs(x) - HALF[0]).max() < 0.06
    assert {-1, 1} == set(np.sign(x))


def test_free_space_ends_at_unseen_space_where_voxels_say_so(room_map):
    """Against a plain loop over all pairs of neighbors."""
    field = hio.snapshot(room_map)
    vertices, faces = scene.edge_of_unseen(field)
    unseen = np.asarray(field.surface.derived.frontier_steps) <= 0
    free = (np.asarray(field.surface.derived.side) == Side.FREE) & ~unseen
    size, corner = CONFIG.voxel_size, np.array(field.config.corner_index)
    expected = set()
    for index in np.ndindex(free.shape):
        for axis in range(3):
            for step in (-1, 1):
                other = list(index)
                other[axis] += step
                if not free[index] or not 0 <= other[axis] < free.shape[axis]:
                    continue
                if unseen[tuple(other)]:
                    middle = (np.array(index) + corner + 0.5) * size
                    middle[axis] += step * size / 2
                    inward = [0, 0, 0]
                    inward[axis] = -step
                    expected.add((*np.round(middle, 4), *inward))
    assert len(expected) > 20
    triangles = vertices[faces].astype(float)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), size**2, rtol=1e-4)
    squares = vertices.reshape(-1, 4, 3).astype(float)
    found = {
        (*np.round(square.mean(axis=0), 4), *np.rint(each / size**2).astype(int))
        for square, each in zip(squares, normal[::2], strict=True)
    }
    assert found == expected
    np.testing.assert_allclose(normal[::2], normal[1::2], atol=1e-6)


def test_an_empty_map_has_no_edge(empty_map):
    vertices, faces = scene.edge_of_unseen(hio.snapshot(empty_map))
    assert vertices.shape == (0, 3) and faces.shape == (0, 3)


def test_the_cloud_lies_in_the_world_without_rows_that_are_no_returns():
    cloud, pose = room_cloud(0, 250, yaw=0.7, position=(0.1, 0.2, 0.0))
    cloud[::5] = np.nan
    shown = scene.thin_cloud(cloud, pose)
    assert shown.shape == (200, 3)
    assert np.abs(room_sdf(shown)).max() < 1e-4
    many = np.random.default_rng(0).normal(size=(45_001, 3))
    assert 10_000 < len(scene.thin_cloud(many, np.eye(4))) <= 20_000
    assert scene.thin_cloud(np.full((3, 3), np.nan), np.eye(4)).shape == (0, 3)


def test_a_camera_is_a_frustum_of_its_view():
    rng = np.random.default_rng(0)
    image = rng.uniform([-0.8, -0.6], [0.8, 0.6], (5000, 2))
    depth = rng.uniform(1, 5, (5000, 1))
    cloud = np.concatenate([image * depth, depth], axis=1)
    pose = np.eye(4)
    pose[:3, 3] = 1, 2, 3
    lines = scene.sensor_lines(cloud, pose) - pose[:3, 3]
    assert lines.shape == (8, 2, 3)
    np.testing.assert_allclose(lines[:4, 0], 0, atol=1e-6)
    corners = lines[:4, 1] / lines[:4, 1, 2:]
    np.testing.assert_allclose(np.abs(corners[:, :2]), [[0.8, 0.6]] * 4, atol=0.02)
    np.testing.assert_allclose(lines[4:, 0], lines[:4, 1], atol=1e-6)  # the far edges close


def test_a_lidar_is_its_axes():
    cloud, pose = room_cloud(3, yaw=0.5)
    lines = scene.sensor_lines(cloud, pose)
    directions = (lines[:, 1] - lines[:, 0]) / np.linalg.norm(
        lines[:, 1] - lines[:, 0], axis=1, keepdims=True
    )
    np.testing.assert_allclose(directions, pose[:3, :3].T, atol=1e-6)
    assert scene.sensor_lines(np.full((2, 3), np.nan), pose).shape == (3, 2, 3)


def test_the_path_joins_positions():
    path = np.arange(12.0).reshape(4, 3)
    lines = scene.path_lines(path)
    np.testing.assert_array_equal(lines[:, 0], path[:-1])
    np.testing.assert_array_equal(lines[:, 1], path[1:])
    assert scene.path_lines(path[:1]).shape == (0, 2, 3)
    assert scene.path_lines(np.empty((0, 3))).shape == (0, 2, 3)


def test_specks_of_a_ceiling_are_left_out():
    room = trimesh.creation.box(extents=(4, 4, 2))
    room.invert()  # its normals point inward: the floor looks up
    speck = trimesh.creation.box(extents=(0.1, 0.1, 0.05))
    speck.apply_translation([1, 1, 0.9])
    table = trimesh.creation.box(extents=(1.5, 1.5, 0.5))
    table.apply_translation([0, 0, -0.7])
    mesh = trimesh.util.concatenate([room, table, speck])
    shown = scene.without_specks(mesh)
    dropped = {tuple(face) for face in mesh.faces} - {tuple(face) for face in shown}
    top = mesh.face_normals @ [0, 0, 1] > 0.9
    of_speck = np.arange(len(mesh.faces)) >= 24
    assert dropped == {tuple(face) for face in mesh.faces[top & of_speck]}


def moment_of(field, index):
    empty = np.empty((0, 3), np.float32)
    return moments.Moment(
        field.replace(updates=np.int32(index)), trimesh.Trimesh(), empty, empty, empty
    )


def test_moments_span_the_whole_run(field, monkeypatch):
    kept = []
    for index in range(500):
        kept = moments.keep(kept, moment_of(field, index))
        assert len(kept) <= 60
        assert kept[0].updates == 0 and kept[-1].updates == index
        steps = np.diff([each.updates for each in kept])
        assert (steps > 0).all()
    assert len(kept) == 60 and steps.max() <= 3 * 500 / 60
    monkeypatch.setattr(moments, "_MOST_BYTES", 3.5 * kept[0].nbytes)
    kept = moments.keep(kept, moment_of(field, 500))
    assert 2 <= len(kept) <= 3 and (kept[0].updates, kept[-1].updates) == (0, 500)


def test_a_moment_has_the_surface_and_the_sensor(field):
    cloud, pose = room_cloud(0)
    moment = moments.capture(field, cloud, pose, np.zeros((2, 3)))
    assert len(moment.mesh.faces) and len(moment.cloud_world) == 250
    assert moment.updates == 48 and moment.nbytes > 1e5
    empty = moments.capture(field, None, None, np.zeros((0, 3)))
    assert len(empty.cloud_world) == len(empty.sensor_world) == 0
