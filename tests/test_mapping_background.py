"""Mapping in a thread: the same map, valid fields, and a planner that never waits."""

import contextlib
import threading
import time

import numpy as np
import pytest
from room import CONFIG, arrays_equal, stream

import hiosdf_jax as hio
from hiosdf_jax._src.mapping.background import serving

POINTS = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 3)).astype(np.float32)


class Unreadable:
    def __array__(self, *_, **__):
        raise RuntimeError("on another device")


def test_the_map_is_that_of_a_plain_loop(empty_map):
    expected = empty_map
    with hio.BackgroundMapper(empty_map) as mapper:
        for k, (cloud, pose) in enumerate(stream(3)):
            mapper.put(cloud, pose, stamp=0.5 * k)
            state = mapper.wait()
            expected = hio.update(expected, cloud, pose)
            assert float(mapper.field.stamp) == 0.5 * k
            assert int(mapper.field.updates) == k + 1
            np.testing.assert_array_equal(hio.sdf(mapper.field, POINTS), hio.sdf(expected, POINTS))
    assert mapper.dropped == 0
    np.testing.assert_array_equal(state.grid.evidence.hits, expected.grid.evidence.hits)


def test_the_newest_frame_replaces_the_waiting_one(empty_map, monkeypatch):
    begun, go = threading.Event(), threading.Event()
    fused = []

    def slow(state, cloud, pose, **_):
        fused.append(float(cloud[0, 0]))
        begun.set()
        assert go.wait(10)
        return state

    monkeypatch.setattr(serving, "update", slow)
    mapper = hio.BackgroundMapper(empty_map)
    pose = np.eye(4)
    mapper.put(np.zeros((1, 3)), pose)
    assert begun.wait(10)
    before = mapper.field
    start = time.perf_counter()
    for k in range(5):
        mapper.put(np.full((1, 3), k + 1), pose)
    assert mapper.field is before  # readable while an update runs
    assert time.perf_counter() - start < 1.0
    assert mapper.dropped == 4
    go.set()
    mapper.close()
    assert fused == [0, 5]
    with pytest.raises(RuntimeError, match="is closed"):
        mapper.put(np.zeros((1, 3)), pose)


class EndlessSensor:
    """A map that lies elsewhere, and a sensor that puts a frame whenever something is done."""

    def __init__(self, state):
        self.state, self.map, self.fault, self.mapper = state, state, None, None

    def put(self):
        with contextlib.suppress(RuntimeError):  # once the mapper is closed
            self.mapper.put(np.ones((1, 3)), np.eye(4))

    def fuse(self, frame, _):
        self.put()
        self.state = None
        return serving.Published(frame.cloud, frame.stamp)

    def fetch(self):
        self.put()
        self.state = self.map
        return self.map

    def stop(self):
        pass


def test_waiting_ends_although_frames_keep_coming(empty_map, monkeypatch):
    sensor = EndlessSensor(empty_map)
    monkeypatch.setattr("hiosdf_jax._src.mapping.background.mapper.Fuser", lambda _: sensor)
    sensor.mapper = mapper = hio.BackgroundMapper(empty_map)
    sensor.put()
    for _ in range(20):
        assert mapper.wait(20.0) is empty_map
    assert mapper.close() is empty_map


def test_a_bad_frame_is_counted_and_mapping_continues(empty_map):
    cloud, pose = stream(1)[0]
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, np.full((4, 4), np.nan))
        mapper.wait()
        mapper.put(cloud, pose)
    assert mapper.rejected == 1
    assert "pose has values that are not finite" in str(mapper.rejection)
    assert int(mapper.field.updates) == 1


def test_a_refused_frame_leaves_the_field_and_its_stamp(empty_map):
    cloud, pose = stream(1)[0]
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, pose, stamp=1.0)
        mapper.wait()
        field = mapper.field
        with pytest.warns(UserWarning, match="cloud has 0 of 250 returns between"):
            mapper.put(cloud + 30, pose, stamp=2.0)
            state = mapper.wait()
        assert mapper.field is field and float(field.stamp) == 1.0
        assert mapper.rejected == 1
        assert "raised the flags OUT_OF_RANGE" in str(mapper.rejection)
        assert hio.Flag.OUT_OF_RANGE in hio.Flag(state.report.update_flags)
        mapper.put(cloud, pose, stamp=3.0)
        mapper.wait()
        assert float(mapper.field.stamp) == 3.0 and int(mapper.field.updates) == 2
    assert mapper.rejected == 1


def test_the_robot_and_the_noise_are_passed_on(empty_map):
    cloud, pose = stream(1)[0]
    # As many spheres as in test_mapping_robot_and_noise.py: one compilation.
    robot = (cloud[:2] @ pose[:3, :3].T + pose[:3, 3], np.full(2, 0.1))
    noise = (0.004, 0.001)
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, pose, robot=robot, noise=noise)
    state = mapper.wait()
    assert arrays_equal(state, hio.update(empty_map, cloud, pose, robot=robot, noise=noise))
    # Both change the map.
    assert int(state.report.points_used) < len(cloud)
    other = hio.update(empty_map, cloud, pose, robot=robot, noise=CONFIG.range_noise)
    assert not arrays_equal(state.grid.evidence, other.grid.evidence)


@pytest.mark.parametrize("given", [{"robot": (np.ones((2, 3)), [0.1, 0.2])}, {"noise": (0.1, 0.2)}])
def test_the_robot_or_the_noise_alone_is_passed_on(empty_map, monkeypatch, given):
    passed = []

    def record(state, *_, **extras):
        passed.append({name: extra for name, extra in extras.items() if extra is not None})
        return state

    monkeypatch.setattr(serving, "update", record)
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(*stream(1)[0], **given)
    (extras,) = passed
    assert extras.keys() == given.keys()
    for name, expected in given.items():
        for part, values in zip(extras[name], expected, strict=True):
            np.testing.assert_allclose(part, values, rtol=1e-6)


@pytest.mark.parametrize(
    "extras, message",
    [
        ({"robot": 3}, "robot is 3"),
        ({"robot": (Unreadable(), [0.1])}, "on another device"),
        ({"noise": (0.0, 0.0)}, "noise a has values"),
    ],
)
def test_bad_extras_are_counted_and_mapping_continues(empty_map, extras, message):
    cloud, pose = stream(1)[0]
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, pose, **extras)
        mapper.wait()
        mapper.put(cloud, pose)
    assert mapper.rejected == 1 and message in str(mapper.rejection)
    assert int(mapper.field.updates) == 1


def test_a_failure_of_the_thread_is_raised_in_the_caller(empty_map, monkeypatch):
    def broken(*_, **__):
        raise OSError("no device")

    monkeypatch.setattr(serving, "update", broken)
    mapper = hio.BackgroundMapper(empty_map)
    mapper.put(*stream(1)[0])
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.wait()
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.put(*stream(1)[0])
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.close()


BAD_CLOUDS = {
    "unreadable": Unreadable(),
    "huge numbers": [[10**400, 0, 0]],
    "complex numbers": np.ones((3, 3), complex),
    "words": [["a", "b", "c"]],
    "nothing": None,
    "an object": object(),
}


@pytest.mark.parametrize("cloud", BAD_CLOUDS.values(), ids=BAD_CLOUDS.keys())
def test_a_frame_of_a_wrong_type_is_counted_and_mapping_continues(empty_map, cloud):
    with hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(cloud, np.eye(4))
        mapper.wait()
        mapper.put(*stream(1)[0])
    assert mapper.rejected == 1 and mapper.rejection is not None
    assert int(mapper.field.updates) == 1


@pytest.mark.parametrize(
    "stamp", [None, "soon", "1.5", True, np.nan, np.inf, 10**400, 1e39, 1.7e9, 1j]
)
def test_a_bad_stamp_is_refused_by_put(empty_map, stamp):
    with hio.BackgroundMapper(empty_map) as mapper:
        with pytest.raises(ValueError, match=r"stamp is .*, expected a finite number of seconds"):
            mapper.put(*stream(1)[0], stamp)
        assert mapper.wait() is empty_map


def test_wrong_arguments_are_named(empty_map):
    with pytest.raises(ValueError, match="state is Field, expected a MapState"):
        hio.BackgroundMapper(hio.snapshot(empty_map))
    with pytest.raises(ValueError, match="serve is 5, expected a function"):
        hio.BackgroundMapper(empty_map, serve=5)
    with hio.BackgroundMapper(empty_map) as mapper:
        for call in (mapper.wait, mapper.close):
            for timeout in ("x", np.nan, np.inf, True):
                with pytest.raises(ValueError, match=r"timeout_s is .*, expected a finite number"):
                    call(timeout)
        with pytest.raises(ValueError, match="serve is 'bake'"):
            mapper.serve = "bake"
        assert mapper.wait(1e300) is empty_map


BAD_FRAMES = {
    **{name: (cloud, np.eye(4)) for name, cloud in BAD_CLOUDS.items()},
    "a cloud of a wrong shape": (np.ones((5, 2)), np.eye(4)),
    "a pose of a wrong shape": (np.ones((5, 3)), np.eye(3)),
    "a pose that is not finite": (np.ones((5, 3)), np.full((4, 4), np.nan)),
    "a pose of words": (np.ones((5, 3)), [["a"] * 4] * 4),
    "a cloud that is out of range": (np.full((250, 3), 90.0), np.eye(4)),
}


@pytest.mark.filterwarnings("ignore:cloud has")
def test_one_bad_frame_in_ten_leaves_the_nine_others(empty_map):
    expected, reasons = empty_map, []
    with hio.BackgroundMapper(empty_map) as mapper:
        for k, bad in enumerate(BAD_FRAMES.values()):
            for frame in [*stream(2), bad]:
                mapper.put(*frame, stamp=float(k))
                mapper.wait()
            reasons.append(str(mapper.rejection))
            for frame in stream(2):
                expected = hio.update(expected, *frame)
        assert mapper.rejected == len(BAD_FRAMES) and mapper.failure is None
    assert int(mapper.field.updates) == 2 * len(BAD_FRAMES)
    np.testing.assert_array_equal(hio.sdf(mapper.field, POINTS), hio.sdf(expected, POINTS))
    assert all(reasons) and len(set(reasons)) >= len(reasons) - 2
    assert "flags OUT_OF_RANGE" in reasons[-1]


def test_the_age_of_the_field_keeps_its_digits(empty_map):
    with hio.BackgroundMapper(empty_map) as mapper:
        assert mapper.age(5.0) == np.inf
        mapper.put(*stream(1)[0], stamp=500_000.000_1)
        mapper.wait()
        assert mapper.age(500_000.000_4) == pytest.approx(3e-4, abs=1e-9)
        with pytest.raises(ValueError, match="now is nan, expected a finite number of seconds"):
            mapper.age(float("nan"))


def test_what_serve_makes_of_a_snapshot_is_the_field(empty_map):
    centers = [np.zeros(3)]

    def window(field):
        return hio.bake(field, 0.2, center=centers[-1], size=(0.8, 0.8, 0.8))

    cloud, pose = stream(1)[0]
    with hio.BackgroundMapper(empty_map, serve=window) as mapper:
        assert isinstance(mapper.field, hio.Baked) and mapper.field.window
        mapper.put(cloud, pose, stamp=1.0)
        state = mapper.wait()
        assert arrays_equal(mapper.field, window(hio.snapshot(state, 1.0)))
        centers.append(np.full(3, np.nan))
        before = mapper.field
        mapper.put(cloud, pose, stamp=2.0)
        mapper.wait()
        assert mapper.rejected == 1 and "center" in str(mapper.rejection)
        assert mapper.field is before and mapper.age(2.0) == 1.0
        centers.append(np.ones(3))
        mapper.put(cloud, pose, stamp=3.0)
        assert int(mapper.wait().updates) == 3
        assert int(mapper.field.updates) == 3


def test_an_exception_of_the_controller_is_kept(empty_map, monkeypatch):
    def broken(*_, **__):
        raise OSError("no device")

    monkeypatch.setattr(serving, "update", broken)
    with pytest.raises(KeyError, match="goal"), hio.BackgroundMapper(empty_map) as mapper:
        mapper.put(*stream(1)[0])
        raise KeyError("goal")
    with pytest.raises(RuntimeError, match="the BackgroundMapper"):
        mapper.put(*stream(1)[0])


def test_a_failure_can_be_read_without_an_exception(empty_map, monkeypatch):
    def broken(*_, **__):
        raise OSError("no device")

    monkeypatch.setattr(serving, "update", broken)
    mapper = hio.BackgroundMapper(empty_map)
    mapper.put(*stream(1)[0])
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.wait()
    assert isinstance(mapper.failure, OSError)
    with pytest.raises(RuntimeError, match="thread has failed"):
        mapper.close()


def test_closing_and_waiting_end_while_a_frame_takes_forever(empty_map, monkeypatch):
    go = threading.Event()

    def endless(state, *_, **__):
        assert go.wait(30)
        return state

    monkeypatch.setattr(serving, "update", endless)
    mapper = hio.BackgroundMapper(empty_map)
    mapper.put(*stream(1)[0])
    for call in (mapper.wait, mapper.close):
        with pytest.raises(TimeoutError, match=r"still works after 0\.1 s"):
            call(timeout_s=0.1)
    go.set()
    mapper.close()
