"""Files for other programs, read back by those programs' readers."""

import base64
import struct
import xml.etree.ElementTree as ElementTree
import zlib

import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from PIL import Image
from room import BOUNDS, CONFIG

import hiosdf_jax as hio
from hiosdf_jax import exports
from hiosdf_jax._src.field.blend import network_sdf
from hiosdf_jax._src.view.exports.by_suffix import SUFFIXES

RESOLUTION = 0.1
POINTS = np.random.default_rng(0).uniform(*BOUNDS, (200, 3)).astype(np.float32)


@pytest.fixture(scope="module")
def field(sharp_map):
    return hio.snapshot(sharp_map)


@pytest.fixture(scope="module")
def baked(field):
    return hio.bake(field, RESOLUTION)


def test_npz_is_the_baked_field_again(field, baked, tmp_path):
    exports.export_map(tmp_path / "field.npz", field, RESOLUTION)
    with np.load(tmp_path / "field.npz", allow_pickle=False) as arrays:
        again = hio.Baked(**arrays)
    for name in ("sdf", "frontier", "lower", "corner_world", "resolution", "updates", "stamp"):
        np.testing.assert_array_equal(getattr(again, name), getattr(baked, name))
    np.testing.assert_array_equal(hio.sdf(again, POINTS), hio.sdf(baked, POINTS))


def check_image(arrays, origin, spacing, baked):
    np.testing.assert_array_equal(np.float32(origin), baked.corner_world)
    assert np.float32(spacing) == pytest.approx([RESOLUTION] * 3)
    for name in ("sdf", "frontier", "lower"):
        np.testing.assert_array_equal(arrays[name], np.asarray(getattr(baked, name)))
    np.testing.assert_array_equal(arrays["observed"], np.asarray(baked.frontier) > 0)


def test_vti_is_what_its_format_says(field, baked, tmp_path, monkeypatch):
    """Against a second reading of VTK's page on its format, with blocks of an odd size."""
    from hiosdf_jax._src.view.exports import lattices

    monkeypatch.setattr(lattices, "_BLOCK_BYTES", 4000)
    exports.export_map(tmp_path / "field.vti", field, RESOLUTION)
    root = ElementTree.parse(tmp_path / "field.vti").getroot()
    image = root.find("ImageData")
    shape = [int(each) + 1 for each in image.get("WholeExtent").split()[1::2]]
    arrays = {}
    for node in image.iter("DataArray"):
        text = node.text.strip()
        blocks, size, partial = struct.unpack("<3Q", base64.b64decode(text[:32]))
        head = -(-8 * (3 + blocks) // 3) * 4
        sizes = struct.unpack(f"<{blocks}Q", base64.b64decode(text[:head])[24:])
        data, at, parts = base64.b64decode(text[head:]), 0, []
        for each in sizes:
            parts.append(zlib.decompress(data[at : at + each]))
            at += each
        assert at == len(data) and {len(part) for part in parts[:-1]} <= {size}
        assert len(parts[-1]) == (partial or size)
        kind = {"Float32": "<f4", "UInt8": "u1"}[node.get("type")]
        arrays[node.get("Name")] = np.frombuffer(b"".join(parts), kind).reshape(shape, order="F")
    origin, spacing = (
        [float(each) for each in image.get(name).split()] for name in ("Origin", "Spacing")
    )
    check_image(arrays, origin, spacing, baked)


def test_vti_is_read_by_vtk(field, baked, tmp_path):
    pyvista = pytest.importorskip("pyvista", reason="needs pyvista: it brings VTK, 200 MB")
    exports.export_map(tmp_path / "field.vti", field, RESOLUTION)
    image = pyvista.read(tmp_path / "field.vti")
    arrays = {
        name: np.asarray(image.point_data[name]).reshape(image.dimensions, order="F")
        for name in image.point_data
    }
    check_image(arrays, image.origin, image.spacing, baked)
    probe = image.sample(image).point_data["sdf"]
    assert len(probe) == baked.sdf.size


def test_safetensors_has_the_network(field, tmp_path):
    numpy_reader = pytest.importorskip("safetensors.numpy", reason="needs safetensors")
    exports.export_map(tmp_path / "net.safetensors", field)
    arrays = numpy_reader.load_file(tmp_path / "net.safetensors")
    x = POINTS.astype(np.float64) - arrays["origin_world"]
    for k in range(CONFIG.hidden_layers + 2):
        z = x @ arrays[f"kernel.{k}"].astype(np.float64) + arrays[f"bias.{k}"]
        x = np.sin(arrays["frequency"] * z)
    assert f"kernel.{k + 1}" not in arrays
    np.testing.assert_allclose(z[:, 0], network_sdf(field, jnp.asarray(POINTS)), atol=2e-5)


def test_ply_has_the_mesh_in_the_world_frame(field, tmp_path):
    exports.export_map(tmp_path / "mesh.ply", field, RESOLUTION)
    mesh = hio.extract_mesh(field, RESOLUTION)
    again = trimesh.load(tmp_path / "mesh.ply", process=False)
    np.testing.assert_array_equal(again.vertices, mesh.vertices)
    np.testing.assert_array_equal(again.faces, mesh.faces)
    np.testing.assert_allclose(again.vertex_normals, mesh.vertex_normals, atol=1e-5)


def test_glb_has_the_mesh_with_y_up_and_colors(field, tmp_path):
    exports.export_map(tmp_path / "mesh.glb", field, RESOLUTION)
    mesh = hio.extract_mesh(field, RESOLUTION)
    (again,) = trimesh.load_scene(tmp_path / "mesh.glb", process=False).geometry.values()
    x, y, z = again.vertices.T
    np.testing.assert_allclose(np.stack([x, -z, y], axis=1), mesh.vertices, atol=1e-6)
    normals = again.vertex_normals
    np.testing.assert_allclose(normals[:, 1], mesh.vertex_normals[:, 2], atol=1e-4)
    assert len(np.unique(again.visual.vertex_attributes["color"], axis=0)) > 10
    assert again.visual.material.metallicFactor == 0.0  # polished metal is the default of glTF


def test_html_has_the_view(field, tmp_path):
    pytest.importorskip("viser", reason="needs the extra 'view'")
    exports.export_map(tmp_path / "scene.html", field)
    assert "__VISER_EMBED_DATA__" in (tmp_path / "scene.html").read_text("utf-8")


def test_pgm_and_yaml_are_read_as_a_map_server_reads_them(field, tmp_path):
    """Trinary mode of nav2's map server: thresholds on (255 - pixel) / 255."""
    yaml = pytest.importorskip("yaml", reason="needs PyYAML")
    robot = {"floor_m": -0.56, "height_m": 0.6, "radius_m": 0.15}
    exports.export_map(tmp_path / "it's.yaml", field, **robot)
    told = yaml.safe_load((tmp_path / "it's.yaml").read_text("utf-8"))
    assert told["mode"] == "trinary" and told["negate"] == 0 and len(told["origin"]) == 3
    with Image.open(tmp_path / told["image"]) as image:
        assert image.mode == "L"
        occupancy = (255 - np.asarray(image)) / 255
    grid = exports.costmap(field, **robot)
    assert told["resolution"] == 0.05 and told["origin"] == [*grid.origin_world, 0.0]
    rows = occupancy[::-1]  # a map server's first cell is the lower left one
    for free_thresh in (told["free_thresh"], 0.25):  # the latter is nav2's own
        occupied, free = rows > told["occupied_thresh"], rows < free_thresh
        np.testing.assert_array_equal(occupied, grid.cells == 0)
        np.testing.assert_array_equal(free, grid.cells == 254)
        np.testing.assert_array_equal(~occupied & ~free, grid.cells == 128)


def test_other_suffixes_and_arguments_are_refused(field, empty_map, tmp_path):
    with pytest.raises(ValueError, match=r"map\.xyz: expected a name with \.npz, \.vti"):
        exports.export_map("map.xyz", field)
    with pytest.raises(ValueError, match="a costmap needs height_m, radius_m"):
        exports.export_map(tmp_path / "map.pgm", field, floor_m=0.0)
    with pytest.raises(ValueError, match=r"\.vti takes no radius_m"):
        exports.export_map(tmp_path / "map.vti", field, radius_m=0.2)
    with pytest.raises(ValueError, match="field is int, expected"):
        exports.export_map(tmp_path / "map.vti", 3)
    with pytest.raises(ValueError, match="the map shows no surface"):
        exports.export_map(tmp_path / "map.glb", empty_map)
    with pytest.raises(ValueError, match="resolution"):
        exports.export_map(tmp_path / "map.vti", field, -1.0)
    assert list(tmp_path.iterdir()) == []


def test_every_suffix_is_described():
    assert set(SUFFIXES) == {
        *(".npz", ".vti", ".pgm", ".yaml", ".safetensors", ".ply", ".glb", ".html")
    }
