"""Mapping in a process: the same map, and neither process outlives or holds up the other."""

import functools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import serving
from room import arrays_equal, stream
from test_mapping_background import BAD_FRAMES, POINTS

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.background import child, worker
from hiosdf_jax._src.mapping.background import serving as frame_loop

HERE = Path(__file__).parent
START = child._START


@pytest.fixture(autouse=True)
def full_priority(monkeypatch):
    """On a busy machine these tests would wait for long."""
    lowers = "os.setpriority(os.PRIO_PROCESS, 0, 19)"
    assert lowers in START
    monkeypatch.setattr(child, "_START", START.replace(lowers, ""))


def test_the_process_has_the_least_priority(empty_map, monkeypatch):
    monkeypatch.setattr(child, "_START", START)
    mapper = hio.BackgroundMapper(empty_map, process=True)
    until(lambda: os.getpriority(os.PRIO_PROCESS, process_of(mapper).pid) == 19)
    process_of(mapper).kill()


def served_around(x):
    return functools.partial(serving.window, center=(x, 0.0, 0.0))


def process_of(mapper):
    return mapper._fuser._process


def test_map_and_field_are_those_of_a_plain_loop(empty_map):
    expected, (cloud, pose) = empty_map, stream(1)[0]
    mapper = hio.BackgroundMapper(empty_map, serve=served_around(0.0), process=True)
    assert arrays_equal(mapper.field, serving.window(hio.snapshot(empty_map), np.zeros(3)))
    assert mapper.wait() is empty_map and mapper.age(0.0) == np.inf
    for k, frame in enumerate(stream(3)):
        mapper.serve = served_around(0.1 * k)
        mapper.put(*frame, stamp=k + 0.1)
        expected = hio.update(expected, *frame)
        assert arrays_equal(mapper.wait(), expected)
        served = mapper.serve(hio.snapshot(expected, k + 0.1))
        assert arrays_equal(mapper.field, served) and mapper.field.window
        assert mapper.age(k + 0.1) == 0.0
    before = mapper.field
    with pytest.warns(UserWarning, match="cloud has 0 of 250 returns between"):
        mapper.put(cloud + 30, pose, stamp=4.0)
        state = mapper.wait()
    assert mapper.rejected == 1 and "flags OUT_OF_RANGE" in str(mapper.rejection)
    assert mapper.field is before
    with pytest.warns(UserWarning, match="cloud has 0 of 250"):
        expected = hio.update(expected, cloud + 30, pose)
    assert arrays_equal(state, expected)
    mapper.serve = None
    extras = {"noise": (0.004, 0.001)}
    with pytest.raises(KeyError, match="goal"), mapper:
        mapper.put(cloud, pose, **extras)
        mapper.wait()
        raise KeyError("goal")
    expected = hio.update(expected, cloud, pose, **extras)
    assert arrays_equal(mapper.wait(), expected)
    assert arrays_equal(mapper.field, hio.snapshot(expected)) and mapper.failure is None
    assert process_of(mapper).poll() is not None
    with pytest.raises(RuntimeError, match="is closed"):
        mapper.put(cloud, pose)


@pytest.mark.filterwarnings("ignore:cloud has")
def test_one_bad_frame_in_ten_leaves_the_nine_others(empty_map):
    expected, reasons = empty_map, []
    with hio.BackgroundMapper(empty_map, process=True) as mapper:
        for bad in BAD_FRAMES.values():
            mapper.put(*bad)
            mapper.wait()
            reasons.append(str(mapper.rejection))
            frame = stream(1)[0]
            mapper.put(*frame)
            mapper.wait()
            expected = hio.update(expected, *frame)
        assert mapper.rejected == len(BAD_FRAMES) and mapper.failure is None
        mapper.serve = functools.partial(serving.window, center=(np.nan, 0, 0))
        mapper.put(*frame)
        mapper.wait()
        assert "center" in str(mapper.rejection)
        assert "in the mapping process" in mapper.rejection.__notes__[0]
        mapper.serve = serving.lock
        mapper.put(*frame)
        mapper.wait()
        assert "serve returned what cannot leave the mapping process" in str(mapper.rejection)
        mapper.serve = serving.warning
        mapper.put(*frame)
        with pytest.warns(UserWarning, match="of serve"):
            mapper.wait()
        for _ in range(3):
            expected = hio.update(expected, *frame)
    assert int(mapper.field.updates) == len(BAD_FRAMES) + 3
    np.testing.assert_array_equal(hio.sdf(mapper.field, POINTS), hio.sdf(expected, POINTS))
    assert all(reasons) and len(set(reasons)) >= len(reasons) - 2
    assert "flags OUT_OF_RANGE" in reasons[-1]


def test_an_exception_that_ends_the_process_is_the_failure(empty_map):
    mapper = hio.BackgroundMapper(empty_map, serve=serving.leave_after_one_update, process=True)
    mapper.put(*stream(1)[0])
    mapper.wait()
    mapper.put(*stream(1)[0])
    for call in (mapper.wait, mapper.close, lambda: mapper.put(*stream(1)[0])):
        with pytest.raises(RuntimeError, match="process has failed"):
            call()
    assert isinstance(mapper.failure, SystemExit) and mapper.failure.code == 3
    assert int(mapper.field.updates) == 1


def until(condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_killed_process_is_noticed_while_it_waits_for_frames(empty_map):
    mapper = hio.BackgroundMapper(empty_map, process=True)
    process_of(mapper).kill()
    until(lambda: mapper.failure is not None)
    assert str(mapper.failure) == "the mapping process was ended by signal 9"
    for call in (mapper.wait, mapper.close, lambda: mapper.put(*stream(1)[0])):
        with pytest.raises(RuntimeError, match="process has failed"):
            call()
    assert int(mapper.field.updates) == 0


def test_a_process_that_hangs_holds_nothing_up(empty_map):
    mapper = hio.BackgroundMapper(empty_map, process=True)
    process_of(mapper).send_signal(signal.SIGSTOP)
    mapper.put(*stream(1)[0])
    for call in (mapper.wait, mapper.close):
        with pytest.raises(TimeoutError, match=r"still works after 0\.1 s"):
            call(timeout_s=0.1)
    process_of(mapper).kill()
    with pytest.raises(RuntimeError, match="process has failed"):
        mapper.close()
    assert "signal 9" in str(mapper.failure)


class Robot:
    def window(self, field):
        return field


CANNOT_CROSS = {
    "a lambda": lambda field: field,
    "a method": Robot().window,
    "a partial of a lambda": functools.partial(lambda field, _: field, 3),
    "a lambda as an argument": functools.partial(serving.window, center=lambda: 0),
    "no function": 5,
}


@pytest.mark.parametrize("serve", CANNOT_CROSS.values(), ids=CANNOT_CROSS.keys())
def test_what_cannot_cross_is_refused(empty_map, serve, monkeypatch):
    monkeypatch.setattr(subprocess, "Popen", None)  # before a process is started
    with pytest.raises(ValueError, match="serve"):
        hio.BackgroundMapper(empty_map, serve=serve, process=True)


def test_a_function_of_the_script_is_refused(monkeypatch):
    monkeypatch.setattr(serving.window, "__module__", "__main__")
    monkeypatch.setattr(sys.modules["__main__"], "window", serving.window, raising=False)
    with pytest.raises(ValueError, match="other than the script that runs"):
        child.pack_serve(serving.window)


def test_a_mapping_process_starts_no_other(empty_map, monkeypatch):
    monkeypatch.setattr(child, "inside", True)
    with pytest.raises(RuntimeError, match="cannot start another"):
        hio.BackgroundMapper(empty_map, process=True)
    with pytest.raises(ValueError, match="process is 1, expected True or False"):
        hio.BackgroundMapper(empty_map, process=1)


def test_an_exception_that_pickle_cannot_write_still_arrives(empty_map, monkeypatch):
    class LocalError(Exception):
        pass

    def broken(*_, **__):
        raise LocalError("no device")

    monkeypatch.setattr(frame_loop, "update", broken)
    frame = frame_loop.Frame(*stream(1)[0], 0.0)
    answer = worker._answer(frame_loop.Fuser(empty_map), "fuse", frame, child.pack_serve(None))
    assert isinstance(answer.raised, RuntimeError)
    assert str(answer.raised) == "LocalError: no device"
