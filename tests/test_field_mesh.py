"""Meshes against planes, spheres and creases known in closed form, and by a slow construction."""

import itertools

import jax
import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from room import HALF

import hiosdf_jax as hio
from hiosdf_jax._src.field import polygons
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.state.pytrees import NO_FEATURE

VOXEL = 0.1
BOUNDS = ((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def field_of(points, toward):
    """A snapshot with the patches of points (N, 3), computed in float64, that face `toward`."""
    config = hio.Config.light(BOUNDS, voxel_size=VOXEL)
    shape = config.grid_shape
    index = np.floor(points / VOXEL).astype(int) - config.corner_index
    nearest = np.full((*shape, 3), NO_FEATURE, np.int8)
    mean, axes = np.zeros((*shape, 3)), np.zeros((*shape, 3, 3))
    for voxel in {tuple(row) for row in index.tolist()}:
        own = points[(index == voxel).all(axis=1)] / VOXEL - config.corner_index
        own -= np.array(voxel) + 0.5
        size, direction = np.linalg.eigh(np.atleast_2d(np.cov(own.T, bias=True)))
        size, direction = np.sqrt(np.maximum(size[::-1], 1e-6)), direction.T[::-1]
        ahead = np.asarray(toward) - (own.mean(axis=0) + voxel + config.corner_index + 0.5) * VOXEL
        normal = direction[2] * (1 if direction[2] @ ahead >= 0 else -1)
        if size[1] < 2e-3:  # on a line: perpendicular to it, toward the sensor
            across = ahead - (ahead @ direction[0]) * direction[0]
            normal = across / np.linalg.norm(across)
        axes[voxel] = size[:, None] * [direction[0], np.cross(normal, direction[0]), normal]
        nearest[voxel], mean[voxel] = 0, own.mean(axis=0)
    field = hio.snapshot(hio.init(config, jax.random.key(0)))
    surface = field.surface
    return field.replace(
        surface=surface.replace(
            mean=mean.astype(np.float16),
            axes=axes.astype(np.float16),
            derived=surface.derived.replace(nearest=nearest),
        )
    )


def distance_to(found, points):
    """Exact distances of points to the triangles of a mesh, m."""
    igl = pytest.importorskip("igl")
    vertices, faces = np.asarray(found.vertices, float), np.asarray(found.faces, np.int64)
    squared, _, _ = igl.point_mesh_squared_distance(np.asarray(points, float), vertices, faces)
    return np.sqrt(np.maximum(squared, 0))


def distance_to_line(points, start, end):
    """Distances of points (N, 3) to the line through two points, m."""
    along = (end - start) / np.linalg.norm(end - start)
    offset = points - start
    return np.linalg.norm(offset - (offset @ along)[:, None] * along, axis=1)


def rotation(seed):
    turn, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return turn * np.sign(np.linalg.det(turn))


def square(seed, turn, center, half=0.6, count=60_000):
    """Random points of a square in the plane whose normal is the last column of `turn`."""
    uv = np.random.default_rng(seed).uniform(-half, half, (count, 2))
    return center + uv @ turn[:, :2].T


def with_planes(points):
    """Leaves out the points in voxels with so few that they may lie on a line."""
    voxel = np.floor(points / VOXEL).astype(int)
    _, row, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    return points[count[row.ravel()] >= 5]


@pytest.mark.parametrize("seed", range(6))
def test_a_square_is_one_flat_piece_without_holes(seed):
    turn = np.eye(3) if seed == 0 else rotation(seed)
    center = np.array([0.03, -0.02, 0.04])
    points = with_planes(square(seed, turn, center))
    found = extract_mesh(field_of(points, center + turn[:, 2]))
    local = (found.vertices - center) @ turn
    # Means and axes are stored with 11 bits.
    assert np.abs(local[:, 2]).max() < 1e-3
    np.testing.assert_allclose(found.vertex_normals @ turn[:, 2], 1, atol=2e-3)
    assert (found.face_normals[found.area_faces > 1e-7] @ turn[:, 2] > 0.9).all()
    # It ends where the square ends, but for some tips in voxels that the border cuts.
    assert np.abs(local[:, :2]).max() < 0.6 + 0.08
    beyond = np.abs(((found.triangles_center - center) @ turn)[:, :2]).max(axis=1) > 0.61
    assert found.area_faces[beyond].sum() < 0.02 * found.area
    assert found.area == pytest.approx(1.2**2, rel=0.03)
    # Away from the border: covered everywhere, and once.
    inner = center + square(seed + 100, turn, 0.0, half=0.5, count=5_000)
    distance = distance_to(found, inner)
    assert np.mean(distance < 2e-3) > 0.995
    assert distance.max() < 0.03
    middle = (np.abs(((found.triangles_center - center) @ turn)[:, :2]) < 0.5).all(axis=1)
    assert found.area_faces[middle].sum() == pytest.approx(1.0, abs=0.03)


def test_a_sphere():
    center, radius = np.array([0.03, -0.01, 0.02]), 0.7
    rays = np.random.default_rng(0).normal(size=(200_000, 3))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = extract_mesh(field_of(center + radius * rays, center), resolution=0.025)
    offset = found.vertices - center
    depth = np.linalg.norm(offset, axis=1)
    # The mean of a voxel's hits lies up to 0.06^2 / (2 * 0.7) = 3 mm inside the sphere.
    assert np.median(np.abs(depth - radius)) < 2e-3
    assert np.percentile(np.abs(depth - radius), 99) < 1e-2
    inwards = -offset / depth[:, None]
    assert np.percentile(np.sum(found.vertex_normals * inwards, axis=1), 1) > 0.95
    assert found.area == pytest.approx(4 * np.pi * radius**2, rel=0.05)


def test_a_sheet_seen_from_both_sides_is_drawn_once():
    """Half of its voxels were seen from the other side."""
    points = square(0, np.eye(3), np.array([0.0, 0.0, 0.04]))
    left, right = points[points[:, 0] < 0], points[points[:, 0] >= 0]
    one, other = field_of(left, (0, 0, 1)), field_of(right, (0, 0, -1))
    a, b = one.surface, other.surface
    whole = one.replace(
        surface=a.replace(
            mean=a.mean + b.mean,
            axes=a.axes + b.axes,
            derived=a.derived.replace(
                nearest=np.maximum(a.derived.nearest, b.derived.nearest)  # NO_FEATURE is the least
            ),
        )
    )
    found = extract_mesh(whole)
    # The border, which no voxel continues, is cut to 1.5 instead of 1.7 deviations.
    assert found.area == pytest.approx(1.2**2, rel=0.05)
    assert np.abs(found.vertices[:, 2] - 0.04).max() < 1e-3
    assert len(trimesh.graph.connected_components(found.edges_unique)) == 1


def test_a_crease_stays_sharp():
    """The floor and the wall of a corner, not on faces of voxels."""
    floor = square(0, np.eye(3), np.array([0.0, 0.0, -0.43]))
    wall = square(1, np.eye(3)[:, [1, 2, 0]], np.array([0.0, 0.0, 0.2]))
    wall[:, 0] = -0.63
    wall = wall[wall[:, 2] > -0.43]
    floor[:, 0] -= 0.03
    found = extract_mesh(field_of(np.concatenate([floor, wall]), (0.5, 0, 0.5)))
    off = np.minimum(np.abs(found.vertices[:, 2] + 0.43), np.abs(found.vertices[:, 0] + 0.63))
    assert np.mean(off < 1e-3) > 0.9
    beside = np.concatenate([floor[floor[:, 0] > -0.5], wall[wall[:, 2] > -0.3]])
    beside = beside[(np.abs(beside[:, 1]) < 0.5) & (beside[:, 0] < 0.4) & (beside[:, 2] < 0.6)]
    distance = distance_to(found, beside[::20])
    assert distance.max() < 2e-3
    # Voxels that hold both planes have one patch, across the edge.
    edge = np.array([[-0.63, y, -0.43] for y in np.linspace(-0.5, 0.5, 50)])
    distance = distance_to(found, edge)
    assert distance.max() < 0.04


def test_the_triangles_of_a_plane_have_common_vertices():
    turn = rotation(3)
    field = field_of(square(3, turn, 0.0), turn[:, 2])
    vertex, normal, face, _ = polygons.triangulate(field.surface)
    found = trimesh.Trimesh(vertex, face, process=False)
    pieces = trimesh.graph.connected_components(
        found.face_adjacency, min_len=1, nodes=np.arange(len(found.faces))
    )
    # Without the strips of two hits.
    pieces = [piece for piece in pieces if found.area_faces[piece].sum() > 0.01]
    found.update_faces(np.concatenate(pieces))
    local = (found.vertices * VOXEL + np.array(field.config.corner_index) * VOXEL) @ turn
    border = found.edges[trimesh.grouping.group_rows(found.edges_sorted, require_count=1)]
    inner = np.abs(local[border].mean(axis=1)[:, :2]).max(axis=1) < 0.45
    assert inner.sum() < 0.03 * len(found.edges_unique)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1, atol=1e-9)


def slow_cut(center, normal, low, high):
    """The corners of a plane's part in a box: where the plane meets the box's twelve edges."""
    found = []
    for axis in range(3):
        others = [k for k in range(3) if k != axis]
        for ends in itertools.product((0, 1), repeat=2):
            point = center.copy()
            for k, end in zip(others, ends, strict=True):
                point[k] = (low, high)[end][k]
            if abs(normal[axis]) < 1e-9:
                continue
            point[axis] = 0.0
            point[axis] = (normal @ center - normal @ point) / normal[axis]
            if low[axis] <= point[axis] <= high[axis]:
                found.append(point)
    return np.array(found).reshape(-1, 3)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_polygons_are_the_cuts_of_planes_with_boxes(seed):
    rng = np.random.default_rng(seed)
    normal = rng.normal(size=(5, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    low, high = rng.uniform(-0.5, -0.01, (5, 3)), rng.uniform(0.01, 0.5, (5, 3))
    center = rng.uniform(low, high)
    sides = np.concatenate([np.eye(3), -np.eye(3)])
    direction = np.broadcast_to(sides[:, None], (6, 5, 3))
    limit = np.concatenate([(high - center).T, (center - low).T])
    cut = polygons.cut_polygons(
        polygons.Patches(center, normal, direction, limit, np.zeros(5, bool))
    )
    for k in range(5):
        corners = cut.corner[k, : cut.count[k]]
        expected = slow_cut(center[k], normal[k], low[k], high[k])
        assert len(corners) >= len(expected) >= 3
        apart = np.linalg.norm(corners[:, None] - expected[None], axis=-1)
        assert apart.min(axis=0).max() < 1e-9 and apart.min(axis=1).max() < 1e-9
        around = np.cross(corners - center[k], np.roll(corners, -1, axis=0) - center[k])
        assert (around @ normal[k] > -1e-12).all()


def test_hits_on_a_line_are_a_narrow_strip_that_faces_the_sensor():
    line = np.stack([np.linspace(0.01, 0.09, 50), np.full(50, 0.03), np.full(50, 0.05)], axis=1)
    toward = np.array([0.05, 0.4, 1.0])
    for points in (line, line[::49], line[20:30]):
        found = extract_mesh(field_of(points, toward))
        ahead = (toward - points.mean(axis=0)) * (0, 1, 1)
        np.testing.assert_allclose(found.vertex_normals @ ahead, np.linalg.norm(ahead), rtol=1e-3)
        low, high = found.bounds
        assert (high - low)[0] == pytest.approx(min(3 * points[:, 0].std(), VOXEL), abs=2e-3)
        assert np.linalg.norm((high - low)[1:]) == pytest.approx(3 * 3e-3 * VOXEL, rel=0.1)
        np.testing.assert_allclose((low + high) / 2, points.mean(axis=0), atol=1e-3)


def test_a_hit_alone_has_no_surface():
    assert len(extract_mesh(field_of(np.full((1, 3), 0.03), (0, 0, 1))).faces) == 0


def test_a_strip_beside_a_plane_leaves_it_as_it_is():
    """Its own plane is not known, so neither continues the other."""
    plane = square(0, np.eye(3), np.array([0.0, 0.0, 0.05]), half=0.3)
    line = np.array([[0.31, 0.05, 0.05], [0.39, 0.05, 0.06]])
    alone, both = (
        extract_mesh(field_of(points, (0.0, 0.0, 1.0)))
        for points in (plane, np.concatenate([plane, line]))
    )
    assert len(both.faces) > len(alone.faces)
    assert both.area == pytest.approx(alone.area, rel=1e-3)
    strip = both.vertices[both.vertices[:, 0] > 0.302]
    assert len(strip) >= 4
    assert distance_to_line(strip, *line).max() < 1e-3


@pytest.mark.parametrize("resolution", [1.0, 0.1, 0.05, 0.025])
def test_the_resolution_is_about_the_length_of_the_edges(resolution):
    field = field_of(square(0, rotation(5), 0.0, count=20_000), rotation(5)[:, 2])
    found = extract_mesh(field, resolution)
    assert found.edges_unique_length.max() < 1.8 * min(resolution, VOXEL)
    assert np.median(found.edges_unique_length) > 0.3 * min(resolution, VOXEL)
    assert found.area == pytest.approx(extract_mesh(field, 0.1).area, rel=1e-3)


def test_the_spread_is_that_of_the_hits():
    points = square(0, np.eye(3), np.array([0.0, 0.0, 0.05]))
    points[:, 2] += np.random.default_rng(1).normal(0, 0.008, len(points))
    found = extract_mesh(field_of(points, (0, 0, 1)))
    np.testing.assert_allclose(found.vertex_attributes["spread"], 0.008, atol=1.5e-3)


def test_misuse_is_named():
    for resolution in (0, -0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"resolution is .*, expected > 0"):
            extract_mesh(None, resolution)
    with pytest.raises(ValueError, match="field is NoneType, expected a MapState or a Field"):
        extract_mesh(None)
    field = field_of(square(0, np.eye(3), np.array([0.0, 0.0, 0.05])), (0, 0, 1))
    for resolution in (1e-9, 1e-320):
        with pytest.raises(ValueError, match="triangles, expected at most 50000000"):
            extract_mesh(field, resolution)


def test_an_empty_map_has_an_empty_mesh():
    empty = hio.init(hio.Config.light(BOUNDS), jax.random.key(0))
    assert len(extract_mesh(empty, resolution=0.2).faces) == 0


def test_a_mapped_room(sharp_map):
    """The wall at x = 0.97 m, meshed to within the map's error."""
    meshes = [
        extract_mesh(field, resolution=0.05) for field in (sharp_map, hio.snapshot(sharp_map))
    ]
    np.testing.assert_array_equal(meshes[0].vertices, meshes[1].vertices)
    found = meshes[0]
    near = np.abs(found.vertices[:, 0] - HALF[0]) < 0.2
    wall = near & (np.abs(found.vertices[:, 1:]) < HALF[1:] - 0.15).all(axis=-1)
    assert wall.sum() > 200
    assert np.median(np.abs(found.vertices[wall, 0] - HALF[0])) < 0.01
    towards_sensor = found.face_normals[np.abs(found.triangles_center[:, 0] - HALF[0]) < 0.1]
    assert np.median(towards_sensor[:, 0]) < -0.9
    # Nothing behind the walls, and no wall without returns.
    assert (np.abs(found.vertices) < HALF + 0.05).all()
