"""Every field of the configuration is checked, and the voxel grid follows from the bounds."""

import ast
import copy
import dataclasses
import inspect
import math
import pickle
import re

import numpy as np
import pytest

import hiosdf_jax as hio

BOUNDS = ((0, 0, 0), (2, 2, 2))
LIMITS = [
    (field.name, *field.metadata["limits"])
    for field in dataclasses.fields(hio.Config)
    if "limits" in field.metadata
]


def test_the_bare_constructor_is_the_default():
    assert hio.Config(BOUNDS) == hio.Config.default(BOUNDS)
    assert hio.Config(BOUNDS) != hio.Config.paper(BOUNDS)


@pytest.mark.parametrize("name", ["light", "paper"])
def test_a_preset_s_help_lists_what_it_changes(name):
    preset = getattr(hio.Config, name)
    text = inspect.getdoc(preset).split("Args:")[0]
    listed = {
        field: ast.literal_eval(value) for field, value in re.findall(r"(\w+)=([\w.-]+)", text)
    }
    own, default = (dataclasses.asdict(each(BOUNDS)) for each in (preset, hio.Config))
    assert listed == {field: value for field, value in own.items() if value != default[field]}


def test_the_paper_s_numbers():
    config = hio.Config.paper(BOUNDS)
    expected = {
        "voxel_size": 0.1,
        "max_points": 50_000,
        "near_samples": 10_000,
        "far_samples": 30_000,
        "near_distance": 0.05,
        "local_points": 1000,
        "local_ray_samples": 20,
        "local_truncation": 0.2,
        "local_max_range": 6.0,
        "hidden_width": 256,
        "hidden_layers": 4,
        "frequency": 10.0,
        "sdf_weight": 5.0,
        "eikonal_weight": 2.0,
        "eikonal_every": 1,
        "learning_rate": 4e-4,
        "weight_decay": 0.012,
        "epochs": 10,
        "batches": 1,
        "warmup_epochs": 50,
        "warmup_updates": 5,
    }
    assert {name: getattr(config, name) for name in expected} == expected


@pytest.mark.parametrize("name, low, high", LIMITS)
def test_limits_are_named(name, low, high):
    for value in (low - 1, high * 2 + 1, math.nan, math.inf):
        with pytest.raises(ValueError, match=rf"Config\.{name} is .*, expected"):
            hio.Config.paper(BOUNDS, **{name: value})
    for value in (True, "3", None):
        with pytest.raises(ValueError, match=rf"Config\.{name} is .*, expected a number"):
            hio.Config.paper(BOUNDS, **{name: value})
    if hio.Config.__dataclass_fields__[name].type == "int":
        with pytest.raises(ValueError, match=rf"Config\.{name} is 2.5, expected a whole number"):
            hio.Config.paper(BOUNDS, **{name: 2.5})


def test_every_number_has_limits():
    limited = {name for name, _, _ in LIMITS} | {"bounds", "range_noise"}
    assert limited == {field.name for field in dataclasses.fields(hio.Config)}


@pytest.mark.parametrize(
    "bounds",
    [
        None,
        3,
        (0, 0, 0),
        ((0, 0), (1, 1)),
        ((0, 0, 0), (1, 1, math.nan)),
        ((0, 0, 0), (1, 0, 1)),
        ((0, 0, 0), (1, math.inf, 1)),
        (("a", 0, 0), (1, 1, 1)),
    ],
)
def test_bad_bounds(bounds):
    with pytest.raises(ValueError, match=r"Config\.bounds"):
        hio.Config.light(bounds)


def test_what_limits_together_forbid():
    with pytest.raises(ValueError, match=r"Config\.max_range is 0.05, expected more than min"):
        hio.Config.paper(BOUNDS, max_range=0.05)
    with pytest.raises(ValueError, match="at most 127 voxels"):
        hio.Config.paper(BOUNDS, voxel_size=0.01, distance_horizon=2.0)
    with pytest.raises(ValueError, match=r"Config\.range_noise"):
        hio.Config.paper(BOUNDS, range_noise=(0, 1))
    with pytest.raises(ValueError, match=r"Config\.range_noise"):
        hio.Config.paper(BOUNDS, range_noise=3)
    with pytest.raises(ValueError, match="expected at most 238609294"):
        hio.Config.paper(((0, 0, 0), (100, 100, 24)))
    hio.Config.paper(((0, 0, 0), (100, 100, 23)))
    with pytest.raises(ValueError, match="no field 'voxelsize'"):
        hio.Config.light(BOUNDS, voxelsize=0.1)
    with pytest.raises(ValueError, match="no field 'voxelsize'"):
        hio.Config(BOUNDS, voxelsize=0.1)
    for flag in (True, np.True_, np.array(True)):
        with pytest.raises(ValueError, match=r"Config\.bounds has booleans"):
            hio.Config(((0, 0, 0), (flag, 1, 1)))


def test_copies_are_the_same():
    config = hio.Config.light(BOUNDS, max_range=5.0)
    assert pickle.loads(pickle.dumps(config)) == copy.deepcopy(config) == config
    assert dataclasses.replace(config, max_range=6.0) == hio.Config.light(BOUNDS, max_range=6.0)


def test_frozen_hashable_and_equal():
    a, b = hio.Config.light(BOUNDS), hio.Config.light(((0.0, 0.0, 0.0), [2, 2, 2]))
    assert a == b
    assert hash(a) == hash(b)
    assert a != hio.Config.paper(BOUNDS)
    with pytest.raises(dataclasses.FrozenInstanceError):
        a.voxel_size = 1.0


@pytest.mark.parametrize(
    "low, high, corner, shape",
    [
        ((0, 0, 0), (0.3, 0.6, 0.7), (0, 0, 0), (3, 6, 7)),
        ((-0.3, -0.05, 0.1), (0.3, 0.05, 0.2), (-3, -1, 1), (6, 2, 1)),
        ((0.14, 0.15, 0.16), (0.21, 0.29, 0.31), (1, 1, 1), (2, 2, 3)),
    ],
)
def test_the_grid_covers_the_bounds_with_whole_voxels(low, high, corner, shape):
    config = hio.Config.light((low, high))
    assert config.corner_index == corner
    assert config.grid_shape == shape


def test_an_editor_shows_the_fields_and_their_defaults():
    parameters = inspect.signature(hio.Config).parameters
    assert list(parameters) == [field.name for field in dataclasses.fields(hio.Config)]
    assert parameters["max_range"].default == 20.0


def test_a_similar_field_is_named():
    with pytest.raises(ValueError, match="no field 'voxelsize'; did you mean 'voxel_size'"):
        hio.Config(BOUNDS, voxelsize=0.1)
