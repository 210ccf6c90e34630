"""Programs that an earlier process has traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import traced_example
from room import CONFIG, arrays_equal, room_cloud
from traced_example import GIVEN, TRACES, Pair, example

import hiosdf_jax as hio
from hiosdf_jax._src.mapping import pipeline
from hiosdf_jax._src.numerics import stored_programs
from hiosdf_jax._src.numerics.stored_programs import is_on_default_device, stored


def run(given=GIVEN):
    """Calls the example as a new process would; returns the result and how often it was traced."""
    TRACES.clear()
    result = jax.jit(stored(example))(given)
    return result, len(TRACES)


@pytest.fixture
def folder(tmp_path):
    """An empty folder for this test's programs."""
    before = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "programs"))
    yield tmp_path / "programs"
    jax.config.update("jax_compilation_cache_dir", before)


def files(folder):
    return sorted(folder.glob("hiosdf_jax-*.stablehlo"))


def test_the_second_process_traces_nothing(folder):
    first, traces = run()
    assert traces == 1
    assert len(files(folder)) == 1
    second, traces = run()
    assert traces == 0
    expected = example(GIVEN)
    assert arrays_equal(first, expected)
    assert arrays_equal(second, expected)
    assert isinstance(second, Pair)


def other_shape(_):
    return GIVEN._replace(first=jnp.arange(5.0))


def other_dtype(_):
    return GIVEN._replace(second=jnp.arange(4.0))


def other_constant(monkeypatch):
    monkeypatch.setattr(traced_example, "OFFSET", 5.0)
    return GIVEN


def other_source(monkeypatch):
    monkeypatch.setattr(stored_programs, "_source_digest", lambda: "another")
    return GIVEN


@pytest.mark.parametrize("change", [other_shape, other_dtype, other_constant, other_source])
def test_a_program_of_other_conditions_is_not_used(folder, monkeypatch, change):
    run()
    given = change(monkeypatch)
    result, traces = run(given)
    assert traces == 1
    assert len(files(folder)) == 2
    assert arrays_equal(result, example(given))


def test_a_program_of_other_settings_is_not_used(folder):
    run()
    with jax.default_matmul_precision("highest"):
        _, traces = run()
    assert traces == 1
    assert len(files(folder)) == 2


def test_a_replaced_function_stores_and_reads_nothing(folder, monkeypatch):
    run()
    monkeypatch.setattr(traced_example, "scale", lambda x: 7 * x)
    result, traces = run()
    assert traces == 1
    assert len(files(folder)) == 1
    np.testing.assert_array_equal(result.first, 7 * GIVEN.first + 2)


@pytest.mark.parametrize("keep", [0, 10, 40, -1])
def test_a_damaged_file_is_replaced(folder, keep):
    run()
    (path,) = files(folder)
    whole = path.read_bytes()
    path.write_bytes(whole[:keep])
    result, traces = run()
    assert traces == 1
    assert arrays_equal(result, example(GIVEN))
    _, traces = run()
    assert traces == 0


def test_a_folder_that_cannot_be_written_is_like_none(folder):
    folder.write_text("a file")
    result, traces = run()
    assert traces == 1
    assert arrays_equal(result, example(GIVEN))


UNUSABLE = {
    "no folder": ("jax_compilation_cache_dir", None),
    "a remote folder": ("jax_compilation_cache_dir", "gs://bucket/folder"),
    "a cache turned off": ("jax_enable_compilation_cache", False),
    "no jit": ("jax_disable_jit", True),
}


@pytest.mark.parametrize("name, value", UNUSABLE.values(), ids=UNUSABLE.keys())
def test_where_programs_cannot_be_stored_they_are_traced(
    folder, monkeypatch, tmp_path, name, value
):
    monkeypatch.chdir(tmp_path)
    before = getattr(jax.config, name)
    jax.config.update(name, value)
    try:
        result, traces = run()
    finally:
        jax.config.update(name, before)
    assert traces == 1
    assert arrays_equal(result, example(GIVEN))
    assert not list(tmp_path.rglob("*.stablehlo"))


def test_a_gpu_stores_nothing(folder, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    _, traces = run()
    assert traces == 1
    assert not files(folder)


def test_an_update_by_a_stored_program_equals_a_traced_one(empty_map, room_map):
    """Twice: as it is stored, and as the next process reads it."""
    cloud, pose = room_cloud(3, CONFIG.max_points)
    prepared = jax.device_put(pipeline.check_and_pad(cloud, pose, CONFIG.max_points))
    arguments = (*prepared, None, None, jnp.uint32(0))
    for state in (empty_map, room_map):
        expected = pipeline._nested_jit(state, *arguments)
        for _ in range(2):
            compiled = jax.jit(stored(pipeline._update))
            assert arrays_equal(compiled(state, *arguments), expected)
        assert arrays_equal(hio.update(state, cloud, pose), expected)


def test_no_function_of_an_update_prevents_storing(room_map):
    """A function that is made by another one would: it may depend on values that no key has."""
    assert stored_programs._key(pipeline._update, stored_programs._type_of(room_map.updates))


def test_arrays_on_other_devices_are_noticed(monkeypatch):
    array = jnp.zeros(3)
    assert is_on_default_device(array)
    monkeypatch.setattr(jax, "local_devices", lambda: ["another"])
    assert not is_on_default_device(array)
