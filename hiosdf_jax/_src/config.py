"""The configuration of a map: every number a user can choose, validated on construction."""

from __future__ import annotations

import dataclasses
import math
import numbers
from typing import Any

Point = tuple[float, float, float]
Bounds = tuple[Point, Point]

# Bounds given as multiples of the voxel size must not gain a voxel from rounding (0.3 / 0.1 < 3).
_LATTICE_TOLERANCE_VOXELS = 1e-4

# The nine numbers of each voxel's principal axes are counted by an int32; such a map has 9.5 GB.
_MOST_VOXELS = (2**31 - 1) // 9


@dataclasses.dataclass(frozen=True)
class Config:
    """Static part of a map: frozen, hashable, validated.

    Make one with `Config.paper`, `Config.light` or `Config.default`; the bare constructor has the
    paper's numbers (HIO-SDF, arXiv 2310.09463; sections in brackets).

    Attributes:
        bounds: Corners ((x0, y0, z0), (x1, y1, z1)) of the mapped box, m, world frame. The grid
            covers it with whole voxels of the lattice that has a corner at the world's origin.
        voxel_size: Edge of a voxel of the coarse grid, m [IV-B].
        max_points: Rows of a cloud that one update uses; larger clouds are drawn from at random,
            smaller ones padded, so that one compilation serves a whole stream [IV-C].
        min_range: Returns nearer than this are ignored, m.
        max_range: Returns farther than this only clear the ray up to it, m.
        range_noise: (a, b) of the standard deviation a + b r^2 of a return at range r, m and 1/m;
            only its relative size matters: hits are averaged with weight 1 / sigma^2.
        min_hits: Hits a voxel needs before its surface counts.
        min_hit_ratio: Share hits / (hits + passes) below which a surface that fills its voxel is
            carved away; of smaller ones less is asked, by their area.
        evidence_limit: Rays a voxel remembers; older evidence fades once there are more.
        distance_horizon: Largest distance that the grid resolves, m; at most 127 voxels.
        frontier_horizon: Largest distance to unseen space that the grid resolves, m.
        near_samples: Samples an update draws where |sdf| < near_distance (the paper's N) [IV-B].
        far_samples: Samples an update draws in the rest of the observed map (M) [IV-B].
        near_distance: The paper's epsilon, m [IV-B].
        local_points: Points of the newest cloud whose rays are sampled (S) [IV-C].
        local_ray_samples: Stratified samples on each of these rays (Q) [IV-C].
        local_truncation: Samples go this far behind the point, and are kept while their distance
            is less (t), m [IV-C].
        local_max_range: Only points nearer than this are chosen for local samples, m.
        hidden_width: Width of the SIREN's layers [IV-A].
        hidden_layers: Sine layers of this width after the input layer [IV-A].
        frequency: The SIREN's omega_0 [IV-A].
        sdf_weight: Weight of the L1 distance loss [IV-D].
        eikonal_weight: Weight of the Eikonal loss [IV-D].
        eikonal_every: The Eikonal loss takes one sample in n, other ones in each epoch.
        learning_rate: Of AdamW [IV-D].
        weight_decay: Of AdamW [IV-D].
        batches: Steps an epoch makes, each on its share of the samples; 1 is the paper's
            full-batch optimisation [IV-D].
        epochs: Epochs an update makes [IV-D].
        warmup_epochs: The same for the first `warmup_updates` updates.
        warmup_updates: How many updates count as the first ones.
        weight_average: Share of the old weights in the running average over updates that queries
            use; 0 serves the latest weights. Training itself never sees the average.
        grid_share: Share of the grid's own distance in what queries answer where it knows one; the
            network has the rest, and all of what lies beyond the horizon. 0 is the paper's.
    """

    bounds: Bounds
    voxel_size: float = 0.10
    max_points: int = 50_000
    min_range: float = 0.1
    max_range: float = 20.0
    range_noise: tuple[float, float] = (0.005, 0.002)
    min_hits: int = 2
    min_hit_ratio: float = 0.25
    evidence_limit: float = 100.0
    distance_horizon: float = 3.0
    frontier_horizon: float = 1.0
    near_samples: int = 10_000
    far_samples: int = 30_000
    near_distance: float = 0.05
    local_points: int = 1_000
    local_ray_samples: int = 20
    local_truncation: float = 0.2
    local_max_range: float = 6.0
    hidden_width: int = 256
    hidden_layers: int = 4
    frequency: float = 10.0
    sdf_weight: float = 5.0
    eikonal_weight: float = 2.0
    eikonal_every: int = 1
    learning_rate: float = 4e-4
    weight_decay: float = 0.012
    batches: int = 1
    epochs: int = 10
    warmup_epochs: int = 50
    warmup_updates: int = 5
    weight_average: float = 0.9
    grid_share: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))
        noise = self.range_noise
        try:
            floor, growth = (float(value) for value in noise)
        except (TypeError, ValueError):
            raise ValueError(
                f"Config.range_noise is {noise!r}, expected two numbers (a, b)"
            ) from None
        object.__setattr__(self, "range_noise", (floor, growth))
        for name, low, high in _LIMITS:
            value = getattr(self, name)
            whole = Config.__dataclass_fields__[name].type == "int"
            if isinstance(value, bool) or not isinstance(value, numbers.Real):
                raise ValueError(f"Config.{name} is {value!r}, expected a number")
            try:
                number = float(value)
            except OverflowError:
                number = math.inf
            if not low <= number <= high:  # also catches NaN
                raise ValueError(f"Config.{name} is {value!r}, expected {low} <= {name} <= {high}")
            if whole and not number.is_integer():
                raise ValueError(f"Config.{name} is {value!r}, expected a whole number")
            object.__setattr__(self, name, int(number) if whole else number)
        if not (0 < floor < math.inf and 0 <= growth < math.inf):
            raise ValueError(f"Config.range_noise is {noise!r}, expected a > 0 and b >= 0")
        if self.max_range <= self.min_range:
            raise ValueError(
                f"Config.max_range is {self.max_range!r}, expected more than min_range, "
                f"{self.min_range!r}"
            )
        for name, horizon in (
            ("distance_horizon", self.horizon_voxels),
            ("frontier_horizon", self.frontier_voxels),
        ):
            if horizon > 127:
                raise ValueError(
                    f"Config.{name} is {getattr(self, name)!r}, expected at most 127 "
                    f"voxels of {self.voxel_size} m, {127 * self.voxel_size:.4g} m"
                )
        samples = self.near_samples + self.far_samples + self.local_points * self.local_ray_samples
        if self.batches > samples:
            raise ValueError(
                f"Config.batches is {self.batches!r}, expected at most one a sample, {samples}"
            )
        voxels = math.prod(self.grid_shape)
        if voxels < 1:
            raise ValueError(
                f"Config.bounds is {self.bounds!r}, expected a box that holds voxels of "
                f"{self.voxel_size} m"
            )
        if voxels > _MOST_VOXELS:
            raise ValueError(
                f"Config.bounds is {self.bounds!r}: {voxels} voxels of {self.voxel_size} m, "
                f"expected at most {_MOST_VOXELS}"
            )

    @classmethod
    def paper(cls, bounds: Any, **overrides: Any) -> Config:
        """The paper's network, samples and schedule.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and bound.
        """
        return cls(**_known({"bounds": bounds} | overrides))

    @classmethod
    def light(cls, bounds: Any, **overrides: Any) -> Config:
        """The same pipeline, sized for two CPU cores.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and bound.
        """
        return cls(**_known(_LIGHT | {"bounds": bounds} | overrides))

    @classmethod
    def default(cls, bounds: Any, **overrides: Any) -> Config:
        """The best we know for a GPU: grid and network served together, more accurate than either.

        The grid's features are also more accurate than the newest cloud alone, so that few local
        samples are left.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and bound.
        """
        return cls(**_known(_DEFAULT | {"bounds": bounds} | overrides))

    @property
    def corner_index(self) -> tuple[int, int, int]:
        """Lattice index of the grid's first voxel: it starts at corner_index * voxel_size, m."""
        low, _ = self._lattice_bounds()
        return low

    @property
    def grid_shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        low, high = self._lattice_bounds()
        return (high[0] - low[0], high[1] - low[1], high[2] - low[2])

    @property
    def horizon_voxels(self) -> int:
        """The distance horizon in whole voxels, rounded up."""
        return math.ceil(self.distance_horizon / self.voxel_size - _LATTICE_TOLERANCE_VOXELS)

    @property
    def frontier_voxels(self) -> int:
        """The frontier's horizon in whole voxels, rounded up."""
        return math.ceil(self.frontier_horizon / self.voxel_size - _LATTICE_TOLERANCE_VOXELS)

    def _lattice_bounds(self) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        (x0, y0, z0), (x1, y1, z1) = self.bounds

        def down(value: float) -> int:
            return math.floor(value / self.voxel_size + _LATTICE_TOLERANCE_VOXELS)

        def up(value: float) -> int:
            return math.ceil(value / self.voxel_size - _LATTICE_TOLERANCE_VOXELS)

        return (down(x0), down(y0), down(z0)), (up(x1), up(y1), up(z1))


# name, least, greatest value; the annotation of the field says whether it must be whole.
_LIMITS: tuple[tuple[str, float, float], ...] = (
    ("voxel_size", 1e-3, 10.0),
    ("max_points", 1, 10_000_000),
    ("min_range", 0.0, 1e4),
    ("max_range", 1e-3, 1e4),
    ("min_hits", 1, 1_000),
    ("min_hit_ratio", 0.0, 1.0),
    ("evidence_limit", 1.0, 1000.0),
    ("distance_horizon", 1e-3, 1e4),
    ("frontier_horizon", 1e-3, 1e4),
    ("near_samples", 1, 10_000_000),
    ("far_samples", 1, 10_000_000),
    ("near_distance", 1e-4, 1e3),
    ("local_points", 1, 1_000_000),
    ("local_ray_samples", 1, 10_000),
    ("local_truncation", 1e-3, 1e3),
    ("local_max_range", 1e-3, 1e4),
    ("hidden_width", 1, 4_096),
    ("hidden_layers", 1, 64),
    ("frequency", 1e-3, 1e3),
    ("sdf_weight", 0.0, 1e6),
    ("eikonal_weight", 0.0, 1e6),
    ("eikonal_every", 1, 1_000),
    ("learning_rate", 0.0, 1.0),
    ("weight_decay", 0.0, 1.0),
    ("batches", 1, 10_000),
    ("epochs", 1, 100_000),
    ("warmup_epochs", 1, 100_000),
    ("warmup_updates", 0, 1_000_000),
    ("weight_average", 0.0, 0.999),
    ("grid_share", 0.0, 1.0),
)

# Grid and network are served together. Measured on an H100 over the streams of the benchmarks, a
# network of half the width with a quarter of the slopes costs 0.01 cm there, and halves the update.
_DEFAULT: dict[str, Any] = {
    "grid_share": 0.9,
    "local_points": 100,
    "hidden_width": 128,
    "eikonal_every": 4,
}

_LIGHT: dict[str, Any] = {
    "max_points": 20_000,
    "near_samples": 8_000,
    "far_samples": 24_000,
    "local_points": 100,
    "local_ray_samples": 10,
    "hidden_width": 128,
    "hidden_layers": 2,
    "batches": 8,
    "eikonal_weight": 0.5,
    "epochs": 1,
    "warmup_epochs": 5,
    "eikonal_every": 2,
    "learning_rate": 1e-3,
    "weight_average": 0.8,
    "grid_share": 0.9,
}


def _known(values: dict[str, Any]) -> dict[str, Any]:
    unknown = sorted(set(values) - set(Config.__dataclass_fields__))
    if unknown:
        raise ValueError(f"Config has no field {unknown[0]!r}")
    return values


def _checked_bounds(bounds: Any) -> Bounds:
    try:
        low, high = (tuple(float(value) for value in corner) for corner in bounds)
    except (TypeError, ValueError):
        low, high = (), ()
    if len(low) != 3 or len(high) != 3:
        raise ValueError(
            f"Config.bounds is {bounds!r}, expected two corners ((x0, y0, z0), (x1, y1, z1))"
        )
    for axis, least, greatest in zip("xyz", low, high, strict=True):
        if not (math.isfinite(least) and math.isfinite(greatest) and least < greatest):
            raise ValueError(
                f"Config.bounds has {axis} from {least} to {greatest}, expected finite, ascending"
            )
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
