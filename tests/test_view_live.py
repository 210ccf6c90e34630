"""The live view, asked from the side of its server."""

import re
import socket
import sys

import jax
import numpy as np
import pytest
from room import BOUNDS, CONFIG, map_of_room, room_cloud, room_sdf, stream

import hiosdf_jax as hio

viser = pytest.importorskip("viser", reason="needs the extra 'view'")


@pytest.fixture(scope="module")
def fields():
    """Snapshots of the room after two, three and four updates."""
    state = map_of_room(CONFIG, jax.random.key(0), 1)
    found = []
    for cloud, pose in stream(4)[1:]:
        state = hio.update(state, cloud, pose)
        found.append(hio.snapshot(state))
    return found


@pytest.fixture
def viewer(fields):
    viewer = hio.view(fields[0], port=0, exact_sdf=room_sdf)
    yield viewer
    viewer.close()


def nodes(viewer):
    return {name.strip("/") for name in viewer._server.scene._handle_from_node_name}


def test_it_serves_this_machine_alone(viewer):
    host, port = re.fullmatch(r"http://([\d.]+):(\d+)", viewer.url).groups()
    assert host == "127.0.0.1"
    with socket.create_connection((host, int(port)), timeout=10):
        pass
    others = {each[4][0] for each in socket.getaddrinfo(socket.gethostname(), None)} - {host}
    for other in others:
        if ":" in other or other.startswith("127."):
            continue
        with pytest.raises(OSError), socket.create_connection((other, int(port)), timeout=2):
            pass


def test_no_tunnel_to_the_outside_can_be_opened(viewer, monkeypatch):
    def refuse(*_, **__):
        pytest.fail("a connection to the outside")

    monkeypatch.setattr("viser._tunnel.ViserTunnel.__init__", refuse)
    assert viewer._server.request_share_url() is None


def test_the_slider_goes_back_in_time(viewer, fields):
    assert {"surface", "slice"} <= nodes(viewer)
    assert not viewer._time.visible
    for field in fields[1:]:
        viewer.show(field, *room_cloud(0))
    assert viewer._time.visible and (viewer._time.max, viewer._time.value) == (2, 2)
    assert viewer._title.content == "**4 updates**"
    assert {"cloud", "sensor", "path"} <= nodes(viewer)
    viewer._time.value = 0
    assert viewer._title.content == "**2 updates**"
    assert "cloud" not in nodes(viewer)
    viewer.show(fields[2], *room_cloud(1))  # who looks at the past is left there
    assert viewer._title.content == "**2 updates**" and viewer._time.value == 0
    viewer._time.value = 3
    assert viewer._title.content == "**4 updates**"


def test_the_slice_moves(viewer):
    drawn = viewer._server.scene.get_handle_by_name("/slice")
    assert drawn.position[2] == pytest.approx((-0.8 + 0.0) / 2)
    viewer._at.value = 0.3
    drawn = viewer._server.scene.get_handle_by_name("/slice")
    assert drawn.position[2] == pytest.approx(0.3)
    viewer._axis.value = "x"
    drawn = viewer._server.scene.get_handle_by_name("/slice")
    assert drawn.position[0] == pytest.approx(0.0)
    assert (viewer._at.min, viewer._at.max) == (BOUNDS[0][0], BOUNDS[1][0])
    assert (drawn.render_width, drawn.render_height) == (2.0, 1.6)


def test_what_is_not_wanted_is_not_drawn(viewer):
    for name, box in viewer._boxes.items():
        box.value = name == "unseen"
    assert nodes(viewer) & {"surface", "slice", "cloud", "sensor"} == set()
    viewer._boxes["surface"].value = True
    assert "surface" in nodes(viewer)


def test_the_surface_can_show_its_error_where_the_truth_is_known(viewer, fields):
    assert "error" in viewer._color.options
    before = viewer._server.scene.get_handle_by_name("/surface").glb_data
    viewer._color.value = "error"
    assert viewer._server.scene.get_handle_by_name("/surface").glb_data != before
    plain = hio.view(fields[0], port=0)
    try:
        assert "error" not in plain._color.options
    finally:
        plain.close()


def test_a_robot_has_the_colors_of_its_clearance(viewer, fields):
    from hiosdf_jax._src.view import colors

    centers, radii = np.array([[0, 0, 0], [0.9, 0, 0]]), np.array([0.1, 0.2])
    viewer.show_robot(centers, radii)
    drawn = viewer._server.scene.get_handle_by_name("/robot")
    clearance = hio.planning.sphere_clearance(fields[0], centers, radii)
    np.testing.assert_array_equal(drawn.batched_colors, colors.CLEARANCE.paint(clearance))
    np.testing.assert_allclose(drawn.batched_scales, radii)
    with pytest.raises(ValueError, match="radii"):
        viewer.show_robot(centers, [-1.0, 1.0])


def test_the_newest_cloud_moves_without_a_new_map(viewer, fields):
    surface = viewer._server.scene.get_handle_by_name("/surface")
    viewer.show_sensor(*room_cloud(2))
    assert {"cloud", "sensor"} <= nodes(viewer)
    assert viewer._server.scene.get_handle_by_name("/surface") is surface


def test_the_page_needs_no_network(viewer, fields, tmp_path):
    viewer.show(fields[1], *room_cloud(0))
    file = tmp_path / "scene.html"
    viewer.export(file)
    text = file.read_text("utf-8")
    assert "__VISER_EMBED_DATA__" in text
    assert '<img alt="legend"' in text and "data:image/png;base64," in text
    loaded = re.findall(r"""<(?:script|link|img)[^>]+(?:src|href)=["']([^"']+)""", text)
    assert all(each.startswith("data:") for each in loaded), loaded


def test_buttons_say_what_they_did(fields, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = []

    class Client:
        def add_notification(self, title, body, **_):
            said.append((title, body))

    state = map_of_room(CONFIG, jax.random.key(0), 1)
    viewer = hio.view(state, port=0)
    try:
        monkeypatch.setattr(viewer._server, "get_clients", lambda: {0: Client()})
        viewer._answer(viewer._on_save)
        assert int(hio.load("map.npz").updates) == 1
        viewer._answer(viewer._write_export)
        assert (tmp_path / "scene.html").stat().st_size > 1e5
        (tmp_path / "scene.html").chmod(0o444)
        viewer._answer(viewer._write_export)
    finally:
        viewer.close()
    assert said[:2] == [("written", "map.npz"), ("written", "scene.html")]
    assert said[2][0] == "not written" and "read-only" in said[2][1]


def test_a_notebook_shows_it(viewer):
    assert f'<iframe src="{viewer.url}"' in viewer._repr_html_()


def test_wrong_arguments_are_named(fields, viewer):
    with pytest.raises(ValueError, match="field is int, expected a MapState or a Field"):
        hio.view(3)
    with pytest.raises(ValueError, match="up_world"):
        hio.view(fields[0], up_world=(0, 0, 0))
    with pytest.raises(ValueError, match=r"host is '203\.0\.113\.7', expected an address"):
        hio.view(fields[0], host="203.0.113.7")
    with pytest.raises(ValueError, match="port is 70000"):
        hio.view(fields[0], port=70_000)
    with pytest.raises(ValueError, match="cloud and pose belong together"):
        viewer.show(fields[0], np.zeros((3, 3)))
    with pytest.raises(ValueError, match="cloud has shape"):
        viewer.show_sensor(np.zeros(3), np.eye(4))
    with pytest.raises(ValueError, match="pose has shape"):
        viewer.show_sensor(np.zeros((2, 3)), np.eye(3))


def test_without_viser_one_line_says_what_to_install(fields, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install '\.\[view\]'"):
        hio.view(fields[0])
