"""Saved maps: complete, safe from crashes, and readable by later versions."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from room import arrays_equal, stream

import hiosdf_jax as hio
from hiosdf_jax._src.change import hiding, vanishing
from hiosdf_jax._src.field import blend
from hiosdf_jax._src.grid.distance import recompute_distances
from hiosdf_jax._src.grid.frontier import recompute_frontier
from hiosdf_jax._src.mapping import stored_values


def test_a_loaded_map_continues_bit_by_bit(room_map, tmp_path):
    path = tmp_path / "map.npz"
    hio.save(path, room_map)
    loaded = hio.load(path)
    assert loaded.config == room_map.config
    assert arrays_equal(loaded, room_map)
    frame = stream(6)[5]
    assert arrays_equal(hio.update(loaded, *frame), hio.update(room_map, *frame))
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


def test_a_saved_file_has_the_permissions_of_any_other(room_map, tmp_path):
    hio.save(tmp_path / "map.npz", room_map)
    (tmp_path / "other").write_bytes(b"")
    assert (tmp_path / "map.npz").stat().st_mode == (tmp_path / "other").stat().st_mode
    assert {path.name for path in tmp_path.iterdir()} == {"map.npz", "other"}


def test_a_failed_save_keeps_the_old_file(room_map, tmp_path, monkeypatch):
    path = tmp_path / "map.npz"
    hio.save(path, room_map)
    before = path.read_bytes()

    def fail(*_, **__):
        raise OSError("disk full")

    monkeypatch.setattr(np, "savez_compressed", fail)
    with pytest.raises(OSError, match="disk full"):
        hio.save(path, room_map)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["map.npz"]


def test_load_names_what_is_wrong(room_map, tmp_path):
    with pytest.raises(FileNotFoundError):
        hio.load(tmp_path / "none.npz")
    broken = tmp_path / "broken.npz"
    broken.write_bytes(b"PK\x03\x04 not a zip")
    with pytest.raises(ValueError, match=r"broken.npz: not a readable npz file"):
        hio.load(broken)
    picture = tmp_path / "picture.png"
    picture.write_bytes(b"\x89PNG and no archive")
    with pytest.raises(ValueError, match=r"picture.png: not a readable npz file \(File is not"):
        hio.load(picture)
    with pytest.raises(FileNotFoundError, match=r"no such folder.*nowhere'"):
        hio.save(tmp_path / "nowhere" / "map", room_map)
    foreign = tmp_path / "foreign.npz"
    np.savez(foreign, a=np.zeros(3))
    with pytest.raises(ValueError, match=r"foreign.npz: not a readable hiosdf_jax map \(it has no"):
        hio.load(foreign)
    path = tmp_path / "map.npz"
    hio.save(path, room_map)
    with np.load(path) as file:
        arrays = {name: file[name] for name in file.files}
    short = {name: array for name, array in arrays.items() if name != "grid.hits"}
    np.savez(path, **short)
    with pytest.raises(ValueError, match=r"lacks the array grid\.hits"):
        hio.load(path)
    np.savez(path, **(arrays | {"grid.hits": arrays["grid.hits"][1:]}))
    with pytest.raises(ValueError, match=r"has grid\.hits of float16"):
        hio.load(path)
    for version in (1, 99):
        other = str(arrays["header"]).replace('"version": 7', f'"version": {version}')
        np.savez(path, **(arrays | {"header": np.asarray(other)}))
        with pytest.raises(ValueError, match=f"format version {version}, expected 2 to 7"):
            hio.load(path)
    # Only files of older versions may lack what newer ones have added.
    for name in (*NEW_ARRAYS, "grid.surface.side"):
        short = {known: array for known, array in arrays.items() if known != name}
        np.savez(path, **short)
        with pytest.raises(ValueError, match=f"lacks the array {name}"):
            hio.load(path)


# What version 3 has added: shapes in the file below, and types.
NEW_ARRAYS = {
    "grid.change": ((4, 3, 2), np.int8),
    "report.points_moving": ((), np.int32),
    "report.refused_in_row": ((), np.int32),
    "report.update_flags": ((), np.uint32),
}
NEW_FIELDS = {"min_in_range": 0.02, "most_refusals": 7, "vanish_scans": 4}


def _most(name):
    """The largest random value of an array: the offsets of patches are in voxels."""
    return 0.5 if name in ("grid.surface.mean", "grid.surface.axes") else 100


def file_of_version_2():
    """The arrays of a saved map under their names in the file, with random values."""
    fields = {
        "bounds": [[-0.2, 0.1, 0.0], [0.2, 0.4, 0.2]],
        "max_points": 300,
        "min_range": 0.2,
        "max_range": 4.5,
        "range_noise": [0.005, 0.002],
        "voxel_size": 0.1,
        "min_hits": 3,
        "min_hit_ratio": 0.2,
        "evidence_limit": 90.0,
        "distance_horizon": 1.0,
        "frontier_horizon": 0.9,
        "near_samples": 400,
        "far_samples": 500,
        "near_distance": 0.06,
        "local_points": 20,
        "local_ray_samples": 5,
        "local_truncation": 0.3,
        "local_max_range": 5.0,
        "hidden_width": 4,
        "hidden_layers": 1,
        "frequency": 11.0,
        "sdf_weight": 4.0,
        "eikonal_weight": 1.5,
        "eikonal_every": 2,
        "learning_rate": 0.001,
        "weight_decay": 0.01,
        "batches": 2,
        "epochs": 3,
        "warmup_epochs": 6,
        "warmup_updates": 7,
        "weight_average": 0.7,
        "grid_share": 0.8,
    }
    header = {
        "format": "hiosdf_jax map",
        "version": 2,
        "config": fields,
        "key": "threefry2x32",
    }
    arrays = {
        "grid.hits": ((4, 3, 2), np.float16),
        "grid.passes": ((4, 3, 2), np.float16),
        "grid.behind": ((4, 3, 2), np.float16),
        "grid.weight": ((4, 3, 2), np.float16),
        "grid.surface.mean": ((4, 3, 2, 3), np.float16),
        "grid.surface.axes": ((4, 3, 2, 3, 3), np.float16),
        "grid.surface.nearest": ((4, 3, 2, 3), np.int8),
        "grid.surface.sdf": ((4, 3, 2), np.float16),
        "grid.surface.doubt": ((4, 3, 2), np.float16),
        "grid.surface.frontier": ((4, 3, 2), np.int8),
        "network.origin_world": ((3,), np.float32),
        "network.optimizer.0.count": ((), np.int32),
        "optimism": ((), np.float32),
        "key": ((2,), np.uint32),
        "updates": ((), np.int32),
        "report.points_used": ((), np.int32),
        "report.points_outside": ((), np.int32),
        "report.points_out_of_range": ((), np.int32),
        "report.points_invalid": ((), np.int32),
        "report.sdf_loss": ((), np.float32),
        "report.eikonal_loss": ((), np.float32),
        "report.flags": ((), np.uint32),
    }
    for copy in ("params", "served", "optimizer.0.mu", "optimizer.0.nu"):
        for layer, (inputs, outputs) in enumerate([(3, 4), (4, 4), (4, 1)]):
            name = f"network.{copy}.params.Dense_{layer}"
            arrays[f"{name}.kernel"] = ((inputs, outputs), np.float32)
            arrays[f"{name}.bias"] = ((outputs,), np.float32)
    rng = np.random.default_rng(0)
    values = {
        name: rng.uniform(0, _most(name), shape).astype(dtype)
        for name, (shape, dtype) in arrays.items()
    }
    return header, values


def test_a_file_of_format_version_2_still_loads(tmp_path):
    header, arrays = file_of_version_2()
    np.savez(tmp_path / "old.npz", header=np.asarray(json.dumps(header)), **arrays)
    state = hio.load(tmp_path / "old.npz")
    config = json.loads(json.dumps(dataclasses.asdict(state.config)))
    defaults = hio.Config.default(state.config.bounds)
    assert config == header["config"] | {name: getattr(defaults, name) for name in NEW_FIELDS}
    evidence, derived, network = state.grid.evidence, state.grid.derived, state.network
    places = {
        "grid.hits": evidence.hits,
        "grid.passes": evidence.passes,
        "grid.behind": evidence.behind,
        "grid.weight": evidence.root_weight,
        "grid.surface.mean": evidence.mean,
        "network.params.params.Dense_1.kernel": network.params["params"]["Dense_1"]["kernel"],
        "network.served.params.Dense_1.kernel": network.average["params"]["Dense_1"]["kernel"],
        "network.served.params.Dense_2.bias": network.average["params"]["Dense_2"]["bias"],
        "network.optimizer.0.mu.params.Dense_0.bias": network.optimizer[0].mu["params"]["Dense_0"][
            "bias"
        ],
        "network.optimizer.0.nu.params.Dense_0.bias": network.optimizer[0].nu["params"]["Dense_0"][
            "bias"
        ],
        "network.origin_world": network.origin_world,
        "optimism": state.optimism,
        "key": jax.random.key_data(state.key),
        "report.flags": state.report.flags,
    }
    for name, array in places.items():
        np.testing.assert_array_equal(array, arrays[name], err_msg=name)
    # The axes become right-handed, and what follows from the evidence is computed anew.
    axes, before = np.asarray(evidence.axes, float), np.asarray(arrays["grid.surface.axes"], float)
    assert (np.linalg.det(axes) > 0).all()
    assert (axes[..., 1, :] != before[..., 1, :]).any()
    np.testing.assert_array_equal(np.abs(axes), np.abs(before))

    @jax.jit
    def recompute(grid):
        return recompute_frontier(state.config, recompute_distances(state.config, grid)).derived

    assert arrays_equal(recompute(state.grid), derived)
    report = state.report
    new = (evidence.change, report.points_moving, report.refused_in_row, report.update_flags)
    for array, (shape, dtype) in zip(new, NEW_ARRAYS.values(), strict=True):
        assert array.shape == shape and array.dtype == dtype
        assert not np.asarray(array).any()


def test_a_map_of_version_2_continues_as_one_of_the_current_version(room_map, tmp_path):
    """A map in which nothing has changed lacks nothing but zeros."""
    hio.save(tmp_path / "new.npz", room_map)
    with np.load(tmp_path / "new.npz") as file:
        newer = (*NEW_ARRAYS, "grid.surface.side")
        arrays = {name: file[name] for name in file.files if name not in newer}
    header = json.loads(str(arrays.pop("header"))) | {"version": 2}
    for name in NEW_FIELDS:  # those of this map are the defaults
        del header["config"][name]
    np.savez(tmp_path / "old.npz", header=np.asarray(json.dumps(header)), **arrays)
    old = hio.load(tmp_path / "old.npz")
    assert old.config == room_map.config
    report, change = room_map.report, room_map.grid.evidence.change
    expected = room_map.replace(
        report=report.replace(
            points_moving=0 * report.points_moving,
            refused_in_row=0 * report.refused_in_row,
            update_flags=0 * report.update_flags,
        ),
        grid=room_map.grid.replace(evidence=room_map.grid.evidence.replace(change=0 * change)),
    )
    assert arrays_equal(old, expected)
    frame = stream(6)[5]
    assert arrays_equal(hio.update(old, *frame), hio.update(expected, *frame))


def file_of_version_3():
    """The same for version 3."""
    header, arrays = file_of_version_2()
    header = header | {"version": 3, "config": header["config"] | NEW_FIELDS}
    new = {name: np.zeros(shape, dtype) for name, (shape, dtype) in NEW_ARRAYS.items()}
    new["grid.change"][1, 2, 0], new["grid.change"][3, 0, 1] = 8, -72
    return header, arrays | new


def test_a_file_of_format_version_3_keeps_its_changes(tmp_path):
    header, arrays = file_of_version_3()
    np.savez(tmp_path / "map.npz", header=np.asarray(json.dumps(header)), **arrays)
    state = hio.load(tmp_path / "map.npz")
    assert json.loads(json.dumps(dataclasses.asdict(state.config))) == header["config"]
    np.testing.assert_array_equal(state.grid.evidence.change, arrays["grid.change"])


def test_names_in_a_file_do_not_change(tmp_path):
    """They are part of its format; attributes of the code may be renamed."""
    header, arrays = file_of_version_3()
    header["version"], arrays["grid.surface.side"] = 7, np.zeros((4, 3, 2), np.int8)
    config = hio.Config(**header["config"])
    hio.save(tmp_path / "map.npz", hio.init(config, jax.random.key(0)))
    with np.load(tmp_path / "map.npz") as file:
        saved = {name: (file[name].shape, file[name].dtype) for name in file.files}
        written = json.loads(str(file["header"]))
    assert saved.pop("header") is not None
    assert saved == {name: (array.shape, array.dtype) for name, array in arrays.items()}
    assert written == header


def test_a_map_whose_distances_do_not_fit_its_evidence_is_refused(room_map, tmp_path):
    hio.save(tmp_path / "map.npz", room_map)
    with np.load(tmp_path / "map.npz") as file:
        arrays = {name: file[name] for name in file.files}
    for name, value, message in (
        ("grid.surface.nearest", -128, "sdf without a patch"),
        ("grid.surface.nearest", 0, "nearest without a patch there"),
        ("grid.surface.frontier", 127, "frontier of the wrong sign"),
        ("grid.surface.frontier", -127, "frontier of the wrong sign"),
        ("grid.hits", 0, "nearest without a patch there"),
        ("grid.surface.sdf", 20, "sdf without a patch|sdf beyond"),
    ):
        changed = np.full_like(arrays[name], value)
        np.savez(tmp_path / "bad.npz", **(arrays | {name: changed}))
        with pytest.raises(ValueError, match=rf"bad.npz has grid\.surface\.({message})"):
            hio.load(tmp_path / "bad.npz")


def test_a_loss_that_failed_is_stored(room_map, tmp_path):
    nothing = jax.numpy.float32(np.nan)
    state = room_map.replace(report=room_map.report.replace(sdf_loss=nothing))
    hio.save(tmp_path / "map.npz", state)
    assert np.isnan(hio.load(tmp_path / "map.npz").report.sdf_loss)


def test_the_limits_of_change_are_those_of_the_stages():
    assert stored_values._LIMITS["grid.change"] == (vanishing._GONE, hiding._NEW_SCANS)
    most = 127 / blend._LEAST_SCALE_VOXELS  # voxels of distance by the least scale
    assert most <= stored_values._LIMITS["optimism"][1] < 1.01 * most
