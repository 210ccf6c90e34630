"""Meshes of planes, spheres and creases known in closed form, and the level by slow numpy."""

import jax
import numpy as np
import pytest
import trimesh
from room import HALF

import hiosdf_jax as hio
from hiosdf_jax._src.field import contouring, implicit_surface
from hiosdf_jax._src.field.mesh import extract_mesh
from hiosdf_jax._src.state.pytrees import NO_FEATURE, Side

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
    # Narrow patches along the border are drawn once more.
    assert found.area == pytest.approx(1.2**2, rel=0.03)
    # Away from the border: covered everywhere, and once.
    inner = center + square(seed + 100, turn, 0.0, half=0.5, count=5_000)
    distance = distance_to(found, inner)
    assert np.mean(distance < 2e-3) > 0.995
    assert distance.max() < 0.03
    middle = (np.abs(((found.triangles_center - center) @ turn)[:, :2]) < 0.5).all(axis=1)
    assert found.area_faces[middle].sum() == pytest.approx(1.0, abs=0.03)


@pytest.mark.parametrize("seed", range(3))
def test_a_square_with_noise_is_one_surface(seed):
    """Its hits lie in two layers of voxels, or three where they are turned."""
    turn = np.eye(3) if seed == 0 else rotation(seed)
    center, noise = np.array([0.03, -0.02, 0.04]), 0.04
    points = square(seed, turn, center)
    height = np.random.default_rng(seed).normal(0, noise, len(points))
    points = points + height[:, None] * turn[:, 2]
    voxel = np.floor(points / VOXEL).astype(int)
    _, row, count = np.unique(voxel, axis=0, return_inverse=True, return_counts=True)
    points = points[count[row.ravel()] > 0.15 * count.max()]  # a map keeps no others
    found = extract_mesh(field_of(points, center + turn[:, 2]))
    local = (found.triangles_center - center) @ turn
    middle = (np.abs(local[:, :2]) < 0.5).all(axis=1)
    # Without joining, the area is 1.6 to 1.9 m^2.
    assert found.area_faces[middle].sum() == pytest.approx(1.0, abs=0.07)
    assert np.percentile(np.abs(local[middle, 2]), 95) < 0.02
    near = (np.abs(((found.vertices - center) @ turn)[:, :2]) < 0.5).all(axis=1)
    assert 0.8 * noise < np.median(found.vertex_attributes["spread"][near]) < 1.4 * noise


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
    found = extract_mesh(field_of(square(3, turn, 0.0), turn[:, 2]))
    np.testing.assert_allclose(np.linalg.norm(found.vertex_normals, axis=1), 1, atol=1e-6)
    pieces = trimesh.graph.connected_components(found.face_adjacency)
    largest = max(pieces, key=len)
    # The others are hits on lines.
    assert found.area_faces[largest].sum() > 0.99 * found.area
    found.update_faces(largest)
    border = found.edges[trimesh.grouping.group_rows(found.edges_sorted, require_count=1)]
    local = found.vertices[border].mean(axis=1) @ turn
    inner = np.abs(local[:, :2]).max(axis=1) < 0.55
    assert inner.sum() < 0.01 * len(found.edges_unique)


def slow_level(surface, points):
    """The surface's function in float64, one point and patch at a time; points in voxels."""
    nearest = np.asarray(surface.derived.nearest)
    mean, axes = (np.asarray(a).astype(float) for a in (surface.mean, surface.axes))
    rows = []
    for point in points:
        known = []
        low = np.floor(point - 0.5).astype(int)
        for step in np.ndindex(2, 2, 2):
            voxel = low + step
            inside = (voxel >= 0).all() and (voxel < nearest.shape[:3]).all()
            if not inside or nearest[tuple(voxel)][0] == NO_FEATURE:
                continue
            site = voxel + nearest[tuple(voxel)]
            u, v, w = axes[tuple(site)]
            offset = point - (site + 0.5 + mean[tuple(site)])
            normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
            reach = offset.copy()
            for axis in (u, v):
                half = 0.9 * 3**0.5 * axis
                reach -= np.clip(reach @ half / max(half @ half, 1e-12), -1, 1) * half
            share = np.prod(np.where(step, point - 0.5 - low, low + 1.5 - point))
            area = np.linalg.norm(u) * np.linalg.norm(v)
            thickness = np.linalg.norm(w)
            rank = np.linalg.norm(reach) + 3 * thickness
            known.append((rank, share * area, offset, normal, reach, thickness))
        if any(patch[-1] < 0.2 for patch in known):
            known = [patch for patch in known if patch[-1] < 0.2]
        if not known:
            rows.append((1.0, 9.0))
            continue
        rank, _, own_offset, own, own_reach, _ = min(known, key=lambda patch: patch[0])
        total = height = 0.0
        blended = np.zeros(3)
        for other_rank, weight, offset, normal, _, _ in known:
            sign = 1
            if normal @ own < -0.7:
                sign = -1
                if abs(own_offset @ own - offset @ own) >= 0.2:
                    continue
            weight = max(weight * np.exp((rank - other_rank) / 0.3), 1e-6)
            total += weight
            height += weight * sign * (offset @ normal)
            blended += weight * sign * normal
        blended /= np.linalg.norm(blended)
        flat = [patch[4] - (patch[4] @ blended) * blended for patch in known]
        side = own_reach - (own_reach @ blended) * blended
        beyond = np.linalg.norm(side) - 0.05
        for reach in flat:
            lengths = np.linalg.norm(side), np.linalg.norm(reach)
            if reach @ side <= -0.7 * np.prod(lengths):
                beyond = min(beyond, sum(lengths) - 0.6)
        nearest_patch = min(np.linalg.norm(patch[4]) for patch in known)
        rows.append((height / total, max(beyond, nearest_patch - 0.45)))
    return np.array(rows).T


def test_the_level_is_that_of_a_slow_reference():
    """Random patches, of which some face away from each other, and some are thick or narrow."""
    rng = np.random.default_rng(0)
    clouds = []
    for _ in range(60):
        low = rng.integers(-4, 4, 3)
        axes = rng.normal(size=(3, 3)) * [[0.25], [0.15], [0.04]] * rng.uniform(0.3, 1, (3, 1))
        spread = (
            0.5 + rng.uniform(-0.2, 0.2, 3) + np.clip(rng.normal(size=(30, 3)) @ axes, -0.2, 0.2)
        )
        clouds.append((low + spread) * VOXEL)
    field = field_of(np.concatenate(clouds), rng.normal(size=3))
    config = field.config
    points = rng.uniform(5, 15, (3_000, 3))
    world = (points + config.corner_index) * VOXEL
    found = implicit_surface.evaluate(config, field.surface, world.astype(np.float32))
    height, beyond = slow_level(field.surface, points)
    assert np.mean(height != 1) > 0.3
    # Where two patches are equally near, rounding chooses.
    np.testing.assert_allclose(np.sort(np.abs(found.height - height))[:-15], 0, atol=2e-3)
    np.testing.assert_allclose(np.sort(np.abs(found.beyond - beyond))[:-60], 0, atol=5e-3)


def lattice(cells=20):
    near = np.zeros((cells + 1 + 2 * contouring.PADDING,) * 3, bool)
    near[2:-2, 2:-2, 2:-2] = True
    # Off the lattice.
    return near, cells / contouring.CELLS_PER_VOXEL / 2 + np.array([0.03, 0.11, 0.07])


def level_of(height, beyond, normal):
    return implicit_surface.Level(height, beyond, normal, normal, height, height)


@pytest.mark.parametrize("outward", [True, False])
def test_the_contour_of_a_sphere_is_closed(outward):
    near, middle = lattice()
    sign = 1 if outward else -1

    def function(position):
        offset = position - middle
        depth = np.linalg.norm(offset, axis=1)
        return level_of(
            sign * (depth - 3.3), np.full(len(depth), -1.0), sign * offset / depth[:, None]
        )

    found = trimesh.Trimesh(*contouring.contour(near, function), process=False)
    assert found.is_watertight and found.is_winding_consistent
    assert found.euler_number == 2
    assert found.volume == pytest.approx(sign * 4 / 3 * np.pi * 3.3**3, rel=0.03)
    assert np.abs(np.linalg.norm(found.vertices - middle, axis=1) - 3.3).max() < 0.03


@pytest.mark.parametrize("seed", range(4))
def test_the_contour_of_a_disc_ends_at_its_edge(seed):
    """Also if the sensor's side changes at random: a sheet that was seen from both sides."""
    near, middle = lattice()
    turn = rotation(seed)
    rng = np.random.default_rng(seed)

    def function(position):
        local = (position - middle) @ turn
        sign = rng.choice([-1.0, 1.0], len(local)) if seed else np.ones(len(local))
        beyond = np.linalg.norm(local[:, :2], axis=1) - 3.2
        return level_of(sign * local[:, 2], beyond, sign[:, None] * turn[:, 2])

    vertex, face = contouring.contour(near, function)
    local = (vertex - middle) @ turn
    assert np.abs(local[:, 2]).max() < 1e-9
    radius = np.linalg.norm(local[:, :2], axis=1)
    assert radius.max() == pytest.approx(3.2, abs=0.03)
    found = trimesh.Trimesh(vertex, face, process=False)
    assert found.area == pytest.approx(np.pi * 3.2**2, rel=0.02)
    border = found.edges[trimesh.grouping.group_rows(found.edges_sorted, require_count=1)]
    assert radius[border].min() > 3.1
    assert found.euler_number == 1
    if not seed:
        assert (found.face_normals @ turn[:, 2] > 0.99).all()


def test_a_gap_is_closed_if_it_is_narrow():
    """Two coplanar squares, 4 cm and 16 cm apart."""
    for gap, closed in ((0.04, True), (0.16, False)):
        points = square(0, np.eye(3), np.array([0.0, 0.0, 0.04]))
        points = points[np.abs(points[:, 0] - 0.05) > gap / 2]
        found = extract_mesh(field_of(points, (0, 0, 1)))
        middle = np.stack([np.full(50, 0.05), np.linspace(-0.5, 0.5, 50), np.full(50, 0.04)], 1)
        distance = distance_to(found, middle)
        assert (distance.max() < 1e-3) if closed else (distance.min() > 0.05)


@pytest.mark.parametrize("across", [False, True])
def test_stray_hits_inside_a_wall_leave_its_sides_whole(across):
    """A wall of one voxel, seen from both sides, with stray hits of both in its middle.

    If the patches of stray hits lie across, the voxels of both sides know them, not their own.
    """
    rng = np.random.default_rng(0)
    sides = [square(k, np.eye(3), np.array([0.0, 0.0, z])) for k, z in enumerate((-0.005, 0.105))]
    stray = rng.uniform([-0.6, -0.6, 0.001], [0.6, 0.6, 0.099], (12_000, 3))
    low, high = field_of(sides[0], (0, 0, -1)), field_of(sides[1], (0, 0, 1))
    inside = field_of(stray, (1.0, 0.3, 0.05))
    surfaces = [field.surface for field in (low, high, inside)]
    nearest = np.max([s.derived.nearest for s in surfaces], axis=0)
    if across:
        middle = -low.config.corner_index[2]
        for layer, step in ((-2, 1), (-1, 1), (1, -1), (2, -1)):
            known = nearest[:, :, middle, 0] != NO_FEATURE
            nearest[known, middle + layer] = (0, 0, step)
    whole = low.replace(
        surface=surfaces[0].replace(
            mean=sum(s.mean for s in surfaces),
            axes=sum(s.axes for s in surfaces),
            derived=surfaces[0].derived.replace(nearest=nearest),
        )
    )
    found = extract_mesh(whole)
    for z in (-0.005, 0.105):
        inner = square(7, np.eye(3), np.array([0.0, 0.0, z]), half=0.5, count=2_000)
        distance = distance_to(found, inner)
        assert np.mean(distance < 0.005) > 0.95
        assert distance.max() < 0.03


def test_hits_on_a_line_are_a_narrow_strip_that_faces_the_sensor():
    line = np.stack([np.linspace(0.01, 0.09, 50), np.full(50, 0.03), np.full(50, 0.05)], axis=1)
    toward = np.array([0.05, 0.4, 1.0])
    for points in (line, line[::49], line[20:30]):
        found = extract_mesh(field_of(points, toward))
        ahead = (toward - points.mean(axis=0)) * (0, 1, 1)
        np.testing.assert_allclose(found.vertex_normals @ ahead, np.linalg.norm(ahead), rtol=1e-3)
        low, high = found.bounds
        assert (high - low)[0] == pytest.approx(
            min(2 * 0.9 * 3**0.5 * points[:, 0].std(), VOXEL), abs=1e-3
        )
        assert np.linalg.norm((high - low)[1:]) == pytest.approx(2 * 5e-3 * VOXEL, rel=0.1)
        np.testing.assert_allclose((low + high) / 2, points.mean(axis=0), atol=1e-3)


def test_a_patch_beside_the_surface_is_drawn_in_free_space_only():
    """One voxel's hits lie 3 cm above those of its neighbors."""
    points = square(0, np.eye(3), np.array([0.0, 0.0, 0.03]))
    above = (np.abs(points[:, :2] - 0.15) < 0.05).all(axis=1)
    points[above, 2] += 0.03
    field = field_of(points, (0, 0, 1))
    derived = field.surface.derived
    count = {}
    for side in Side:
        sides = np.full(derived.side.shape, side, np.int8)
        surface = field.surface.replace(derived=derived.replace(side=sides))
        found = extract_mesh(field.replace(surface=surface))
        count[side] = len(found.faces)
        beside = square(5, np.eye(3), np.array([-0.3, 0.0, 0.03]), half=0.2, count=500)
        assert distance_to(found, beside).max() < 1e-3
        if side in (Side.FREE, Side.SHEET):
            middle = points[above & (np.linalg.norm(points[:, :2] - 0.15, axis=1) < 0.02)]
            assert distance_to(found, middle).max() < 1e-3
    assert count[Side.FREE] == count[Side.SHEET] > count[Side.PLANE]
    assert count[Side.PLANE] == count[Side.BEHIND] == count[Side.UNKNOWN]


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_a_wall_is_smoothed(seed):
    """A centimeter of noise, 40 hits in each voxel; unsmoothed it is 3.5 degrees and 2 mm."""
    points = square(seed, np.eye(3), np.array([0.0, 0.0, 0.04]), count=6_000)
    points[:, 2] += np.random.default_rng(seed + 9).normal(0, 0.01, len(points))
    found = extract_mesh(field_of(points, (0, 0, 1)))
    inner = (np.abs(found.triangles_center[:, :2]) < 0.5).all(axis=1)
    tilt = np.degrees(np.arccos(np.clip(found.face_normals[inner, 2], -1, 1)))
    assert np.average(tilt, weights=found.area_faces[inner]) < 1.2
    assert np.abs(found.vertices[:, 2] - 0.04).mean() < 1.2e-3


def test_a_thin_solid_keeps_its_two_sides():
    """A board of 3 cm across a face of voxels, with 8 mm of noise."""
    rng = np.random.default_rng(0)
    sides = []
    for sign in (-1, 1):
        points = square(sign + 1, np.eye(3), np.array([0.0, 0.0, 0.015 * sign]))
        points[:, 2] += np.clip(rng.normal(0, 0.008, len(points)), -0.014, 0.014)
        sides.append(field_of(points, (0, 0, sign)).surface)
    whole = sides[0].replace(
        mean=sides[0].mean + sides[1].mean,
        axes=sides[0].axes + sides[1].axes,
        derived=sides[0].derived.replace(
            nearest=np.maximum(sides[0].derived.nearest, sides[1].derived.nearest)
        ),
    )
    found = extract_mesh(field_of(np.zeros((1, 3)), (1, 2, 3)).replace(surface=whole))
    assert found.area == pytest.approx(2 * 1.2**2, rel=0.05)
    assert np.abs(found.vertices[:, 2]).mean() == pytest.approx(0.015, abs=2e-3)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_plane_at_the_border_of_the_grid_is_drawn_once(sign):
    height = 0.999 * sign
    points = square(0, np.eye(3), np.array([0.0, 0.0, height]))
    found = extract_mesh(field_of(points, (0, 0, 0)))
    assert found.area == pytest.approx(1.2**2, rel=0.03)
    assert np.abs(found.vertices[:, 2] - height).max() < 1e-3


def test_a_hit_alone_has_no_surface():
    assert len(extract_mesh(field_of(np.full((1, 3), 0.03), (0, 0, 1))).faces) == 0


def test_a_strip_beside_a_plane_leaves_it_as_it_is():
    """Its own plane is not known; it closes no more than the gap to the plane."""
    plane = square(0, np.eye(3), np.array([0.0, 0.0, 0.05]), half=0.3)
    line = np.array([[0.31, 0.05, 0.05], [0.39, 0.05, 0.06]])
    alone, both = (
        extract_mesh(field_of(points, (0.0, 0.0, 1.0)))
        for points in (plane, np.concatenate([plane, line]))
    )
    assert len(both.faces) > len(alone.faces)
    assert both.area == pytest.approx(alone.area, rel=1e-2)
    plane_areas = [m.area_faces[m.triangles_center[:, 0] < 0.15].sum() for m in (alone, both)]
    assert plane_areas[1] == pytest.approx(plane_areas[0], rel=1e-3)
    assert distance_to_line(both.vertices[-4:], *line).max() < 1e-3  # the rectangle of the strip


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
    plane = square(0, np.eye(3), np.array([0.0, 0.0, 0.05]))
    for points in (plane, np.array([[0.01, 0.03, 0.05], [0.09, 0.03, 0.05]])):
        for resolution in (1e-9, 1e-320):
            with pytest.raises(ValueError, match="triangles, expected at most 50000000"):
                extract_mesh(field_of(points, (0, 0, 1)), resolution)


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
