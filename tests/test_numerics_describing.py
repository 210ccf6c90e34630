"""The `repr` of maps and fields: short, and of any leaves."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hiosdf_jax as hio
from hiosdf_jax._src.numerics.describing import describe


def described(tree):
    """The text without its line breaks."""
    return " ".join(repr(tree).split())


def test_a_map_is_described_by_the_types_of_its_leaves(room_map):
    text = described(room_map)
    x, y, z = room_map.config.grid_shape
    assert f"grid=Grid( evidence=Evidence( hits=float16[{x},{y},{z}]," in text
    assert f"updates={int(room_map.updates)}, report=Report( points_used=" in text
    assert "key=key<fry>[]" in text


@pytest.mark.parametrize("kind", [hio.snapshot, lambda state: hio.bake(state, 0.1)])
def test_the_text_is_short(room_map, kind):
    assert len(repr(room_map)) < 4_000
    assert len(repr(kind(room_map))) < 2_000


def test_a_configuration_shows_what_differs_from_the_default(empty_map):
    config = hio.Config(((0, 0, 0), (1, 1, 1)), hidden_width=32)
    state = dataclasses.replace(empty_map, config=config)
    bounds = "((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))"
    assert f"config=Config(bounds={bounds}, hidden_width=32)," in described(state)


def test_traced_and_stacked_leaves_have_their_types(empty_map):
    texts = []
    jax.jit(lambda report: texts.append(described(report)))(empty_map.report)
    assert "flags=traced uint32[] )" in texts[0]
    stack = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), empty_map)
    assert "flags=uint32[2] )" in described(stack.report)
    assert "key=key<fry>[2]" in described(stack)


def test_a_donated_leaf_is_named_so(empty_map):
    report = jax.tree.map(jnp.copy, empty_map.report)
    report.flags.delete()
    assert "flags=donated uint32[] )" in described(report)


@pytest.mark.parametrize(
    ("leaf", "text"),
    [
        (None, "None"),
        ("name", "'name'"),
        (object, "<class 'object'>"),
        ("x" * 1000, "<str>"),
        (np.float32(2.5), "2.5"),
        (np.zeros((3, 0)), "float64[3,0]"),
        (jax.ShapeDtypeStruct((), jnp.int32), "int32[]"),
        ([1, (2,), {"a": ()}], "[1, (2,), {'a': ()}]"),
    ],
)
def test_other_leaves(empty_map, leaf, text):
    assert describe(leaf) == text
    assert f"flags={text} )" in described(empty_map.report.replace(flags=leaf))


def test_long_nodes_are_indented():
    x, y = "x" * 50, "y" * 50
    text = describe({"a": [x, y], "b": 1})
    assert text == f"{{\n  'a': [\n    '{x}',\n    '{y}'\n  ],\n  'b': 1\n}}"


def test_a_value_is_read_under_the_transfer_guard(empty_map):
    with jax.transfer_guard("disallow"):
        assert "updates=0" in described(empty_map)
