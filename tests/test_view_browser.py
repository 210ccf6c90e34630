"""The live view and its page in a real browser."""

import time

import browser
import numpy as np
import pytest
from room import room_cloud

import hiosdf_jax as hio

pytest.importorskip("viser", reason="needs the extra 'view'")
if browser.PROGRAM is None:
    pytest.skip(
        "needs the program chromium (Debian: apt install chromium)", allow_module_level=True
    )

# Where the scene is; the panel covers the rest.
SCENE = (slice(150, 640), slice(330, 930))


def has_colors(picture):
    """Whether much of the scene is drawn in colors; the grid and the empty page are gray."""
    part = picture[SCENE].astype(int)
    return (np.ptp(part, axis=-1) > 30).mean() > 0.05


def test_it_shows_the_map_and_the_slice_moves(sharp_map, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # the button writes a file there
    field = hio.snapshot(sharp_map)
    viewer = hio.view(field, port=0, spheres=([[0.0, 0.0, 0.2]], 0.1))
    try:
        viewer.show(field, *room_cloud(0))
        with browser.opened(viewer.url, tmp_path) as page:
            first = page.wait_for(has_colors)
            words = page.text()
            for label in ("color by", "slice at [m]", "snapshot", "unseen space", "48 updates"):
                assert label in words
            viewer._at.value = 0.5

            def has_moved(picture):
                change = np.abs(picture[SCENE].astype(int) - first[SCENE]).max(axis=-1)
                return (change > 30).mean() > 0.03

            page.wait_for(has_moved)
            page.click("export as HTML")
            end = time.monotonic() + 60
            while not (tmp_path / "scene.html").exists():
                assert time.monotonic() < end, "the button has written nothing"
                time.sleep(0.1)
            assert page.errors == []
    finally:
        viewer.close()


def test_the_page_shows_the_map_without_a_server(sharp_map, tmp_path):
    viewer = hio.view(hio.snapshot(sharp_map), port=0)
    try:
        viewer.export(tmp_path / "scene.html")
    finally:
        viewer.close()
    with browser.opened((tmp_path / "scene.html").as_uri(), tmp_path) as page:
        picture = page.wait_for(has_colors)
        assert page.errors == []
    legend = picture[400:600, 20:300].astype(int)  # the bars, at the lower left
    assert (np.ptp(legend, axis=-1) > 60).any()
