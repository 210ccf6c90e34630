"""The garbage collector is paused while something may compile, and is as before afterwards."""

import gc

import pytest
from room import CONFIG, room_cloud

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.numerics.collecting import collector_paused


@pytest.fixture(autouse=True)
def collector():
    """Leaves the collector as it was, even if a test fails."""
    was_on = gc.isenabled()
    yield
    (gc.enable if was_on else gc.disable)()


@pytest.mark.parametrize("on", [True, False])
def test_the_collector_is_as_before(on):
    (gc.enable if on else gc.disable)()
    with collector_paused():
        assert not gc.isenabled()
        with collector_paused():
            assert not gc.isenabled()
        assert not gc.isenabled()
    assert gc.isenabled() == on


def test_an_error_turns_it_on_again():
    gc.enable()
    with pytest.raises(KeyError), collector_paused():
        raise KeyError
    assert gc.isenabled()


def test_an_update_is_traced_without_it(empty_map, monkeypatch):
    seen = []
    monkeypatch.setattr(
        pipeline, "_update_jit", lambda *arguments: seen.append(gc.isenabled()) or arguments[0]
    )
    gc.enable()
    hio.update(empty_map, *room_cloud(0, CONFIG.max_points))
    assert seen == [False]
    assert gc.isenabled()
