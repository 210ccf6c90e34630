"""Meshes against spheres, boxes and walls known in closed form."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from room import HALF

import hiosdf_jax as hio
from hiosdf_jax._src.field import mesh
from hiosdf_jax._src.field.mesh import extract_mesh, mesh_from_samples
from hiosdf_jax._src.state import Query

CENTER = np.array([0.13, -0.21, 0.07])
CORNER = np.array([-1.5, -1.2, -1.4])


def lattice(resolution, shape=(60, 55, 58)):
    return CORNER + resolution * np.stack(np.indices(shape), axis=-1)


def sphere_samples(resolution=0.05, radius=0.8):
    return np.linalg.norm(lattice(resolution) - CENTER, axis=-1) - radius


def test_sphere():
    sdf = sphere_samples()
    found = mesh_from_samples(sdf, np.ones(sdf.shape, bool), CORNER, 0.05)
    offset = found.vertices - CENTER
    # A chord over a cell is h^2 / (8 r) = 0.4 mm off.
    np.testing.assert_allclose(np.linalg.norm(offset, axis=-1), 0.8, atol=6e-4)
    assert found.is_watertight
    assert found.volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.01)  # > 0: outwards
    outwards = (found.triangles_center - CENTER) / 0.8
    real = found.area_faces > 1e-8
    assert (np.sum(found.face_normals * outwards, axis=-1)[real] > 0.9).all()


def test_the_faces_of_a_room_point_inwards():
    sdf = -sphere_samples()
    found = mesh_from_samples(sdf, np.ones(sdf.shape, bool), CORNER, 0.05)
    assert found.is_watertight
    assert found.volume == pytest.approx(-4 / 3 * np.pi * 0.8**3, rel=0.01)


def test_a_box_with_faces_on_the_samples():
    corner, resolution = np.zeros(3), 0.25  # exact in binary: the faces' samples are exactly 0
    points = resolution * np.stack(np.indices((13, 13, 13)), axis=-1)
    outside = np.abs(points - 1.5) - np.array([1.0, 0.75, 0.5])
    sdf = np.linalg.norm(np.maximum(outside, 0), axis=-1) + np.minimum(outside.max(axis=-1), 0)
    found = mesh_from_samples(sdf, np.ones(sdf.shape, bool), corner, resolution)
    assert found.is_watertight
    np.testing.assert_allclose(found.bounds, [[0.5, 0.75, 1.0], [2.5, 2.25, 2.0]], atol=1e-5)
    # The first sample inside from an edge is the first that is negative: edges are bevelled.
    assert 0.8 * 3.0 < found.volume < 3.0


def test_only_observed_space_has_a_surface():
    sdf = sphere_samples()
    observed = lattice(0.05)[..., 0] < CENTER[0]
    found = mesh_from_samples(sdf, observed, CORNER, 0.05)
    last = lattice(0.05)[observed][:, 0].max()
    assert last < found.vertices[:, 0].max() <= last + 0.05 + 1e-6
    whole = mesh_from_samples(sdf, np.ones(sdf.shape, bool), CORNER, 0.05)
    reachable = whole.vertices[:, 0] <= last
    assert len(found.vertices) >= reachable.sum()
    farther = mesh_from_samples(sdf, observed, CORNER, 0.05, reach=3)
    assert farther.vertices[:, 0].max() == pytest.approx(last + 0.15, abs=1e-5)


def test_the_unseen_back_of_a_wall_is_no_surface():
    # Free for x < 1, behind the surface for 0.27 m, and then the map guesses "free" again.
    x = lattice(0.05, (80, 10, 10))[..., 0]
    sdf = np.maximum(1.0 - x, x - 1.27)
    found = mesh_from_samples(sdf, x < 1.26, CORNER, 0.05)
    np.testing.assert_allclose(found.vertices[:, 0], 1.0, atol=1e-5)
    np.testing.assert_allclose(found.face_normals, [[-1, 0, 0]] * len(found.faces), atol=1e-6)
    everything = mesh_from_samples(sdf, x < 1.31, CORNER, 0.05)
    assert everything.vertices[:, 0].max() == pytest.approx(1.27, abs=1e-5)


def test_nan_is_not_observed():
    sdf = sphere_samples()
    hole = lattice(0.05)[..., 2] > CENTER[2] + 0.4
    found = mesh_from_samples(np.where(hole, np.nan, sdf), np.ones(sdf.shape, bool), CORNER, 0.05)
    assert len(found.faces) > 1000
    assert found.vertices[:, 2].max() < CENTER[2] + 0.4 + 1e-6
    np.testing.assert_allclose(np.linalg.norm(found.vertices - CENTER, axis=-1), 0.8, atol=6e-4)


@pytest.mark.parametrize("fill", ["free", "behind", "unseen", "unknown", "hidden crossing"])
def test_no_surface_is_an_empty_mesh(fill):
    sdf, observed = np.ones((8, 9, 7)), np.ones((8, 9, 7), bool)
    if fill == "behind":
        sdf = -sdf
    elif fill == "unseen":
        sdf, observed = sphere_samples(), np.zeros((60, 55, 58), bool)
    elif fill == "unknown":
        sdf = np.full(sdf.shape, np.nan)
    elif fill == "hidden crossing":
        sdf[6:] = -1
        observed[4:] = False
    found = mesh_from_samples(sdf, observed, np.zeros(3), 0.1)
    assert len(found.faces) == len(found.vertices) == 0


def test_a_single_layer_has_no_surface():
    found = mesh_from_samples(np.ones((1, 5, 5)), np.ones((1, 5, 5), bool), np.zeros(3), 0.1)
    assert len(found.faces) == 0


def test_misuse_is_named():
    sdf, observed = np.ones((4, 4, 4)), np.ones((4, 4, 4), bool)
    for resolution in (0, -0.1, np.nan, np.inf):
        with pytest.raises(ValueError, match=r"resolution is .*, expected > 0"):
            mesh_from_samples(sdf, observed, np.zeros(3), resolution)
        with pytest.raises(ValueError, match=r"resolution is .*, expected > 0"):
            extract_mesh(None, resolution)
    with pytest.raises(ValueError, match="reach is 0"):
        mesh_from_samples(sdf, observed, np.zeros(3), 0.1, reach=0)
    with pytest.raises(ValueError, match=r"sdf has shape \(4, 4\)"):
        mesh_from_samples(sdf[0], observed, np.zeros(3), 0.1)
    with pytest.raises(ValueError, match=r"observed has shape \(3, 4, 4\)"):
        mesh_from_samples(sdf, observed[1:], np.zeros(3), 0.1)
    with pytest.raises(ValueError, match=r"corner_world has shape \(2,\)"):
        mesh_from_samples(sdf, observed, np.zeros(2), 0.1)


@pytest.fixture
def uneven_map():
    """An empty map whose bounds are no multiples of the voxel size."""
    config = hio.Config.light(bounds=((-1.03, -1.2, -0.9), (1.1, 1.0, 1.3)), voxel_size=0.1)
    return hio.init(config, jax.random.key(0))


def test_a_map_is_sampled_over_its_bounds(monkeypatch, uneven_map):
    shapes, samples = set(), []

    def sphere_query(field, points):
        """Stands in for a trained map: a sphere whose lower part was observed."""
        shapes.add(points.shape)
        jax.debug.callback(lambda p: samples.append(np.asarray(p)), points)
        sdf = jnp.linalg.norm(points - CENTER, axis=-1) - 0.8
        return Query(sdf, points, points[:, 2] < 0.02, sdf, sdf)

    monkeypatch.setattr(mesh, "query", sphere_query)
    plain = mesh._sample.__wrapped__
    # A function of its own: JAX shares compilations between the jitted forms of one function.
    monkeypatch.setattr(mesh, "_sample", jax.jit(lambda *arguments: plain(*arguments)))
    monkeypatch.setattr(mesh, "_CHUNK", 1000)
    found = extract_mesh(uneven_map, resolution=0.05)
    jax.effects_barrier()
    assert shapes == {(1000, 3)}
    assert mesh._sample._cache_size() == 1
    low, high = np.asarray(uneven_map.config.bounds)
    samples = np.concatenate(samples)
    np.testing.assert_allclose(samples.min(axis=0), low, atol=1e-6)
    assert (samples.max(axis=0) >= high - 1e-6).all()
    assert (samples.max(axis=0) < high + 0.05).all()
    np.testing.assert_allclose(np.linalg.norm(found.vertices - CENTER, axis=-1), 0.8, atol=6e-4)
    # One voxel of the map beyond what was observed, whatever the resolution.
    assert found.vertices[:, 2].max() == pytest.approx(0.1, abs=1e-5)
    assert found.vertices[:, 2].min() == pytest.approx(CENTER[2] - 0.8, abs=1e-3)


def test_an_empty_map_has_an_empty_mesh(uneven_map):
    assert len(extract_mesh(uneven_map, resolution=0.2).faces) == 0


def test_a_mapped_room(sharp_map):
    """The wall at x = 0.97 m, meshed to within the map's error."""
    for field in (sharp_map, hio.snapshot(sharp_map)):
        found = extract_mesh(field, resolution=0.05)
        near = np.abs(found.vertices[:, 0] - HALF[0]) < 0.2
        wall = near & (np.abs(found.vertices[:, 1:]) < HALF[1:] - 0.15).all(axis=-1)
        assert wall.sum() > 200
        assert np.median(np.abs(found.vertices[wall, 0] - HALF[0])) < 0.05
        towards_sensor = found.face_normals[np.abs(found.triangles_center[:, 0] - HALF[0]) < 0.1]
        assert np.median(towards_sensor[:, 0]) < -0.9
