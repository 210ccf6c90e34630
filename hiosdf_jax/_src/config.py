"""The configuration of a map: every number that a user can choose, checked on construction."""

from __future__ import annotations

import dataclasses
import difflib
import inspect
import math
import numbers
from typing import Any, Self

from hiosdf_jax._src.numerics.intake import as_real
from hiosdf_jax._src.numerics.rigid import FARTHEST_M

_MOST_NOISE = 1e6  # larger, or smaller than 1e-6, a return's weight is no float32

Point = tuple[float, float, float]
Bounds = tuple[Point, Point]

# Bounds that are multiples of the voxel size must not gain a voxel from rounding (0.3 / 0.1 < 3).
_TOLERANCE_VOXELS = 1e-4

# An int32 counts the nine numbers of each voxel's principal axes. Such a map has 10 GB.
_MOST_VOXELS = (2**31 - 1) // 9


def _number(default: float, least: float, greatest: float) -> Any:
    """Makes a field with its limits; its annotation says whether it must be whole."""
    return dataclasses.field(default=default, metadata={"limits": (least, greatest)})


@dataclasses.dataclass(frozen=True)
class Config:
    """Static part of a map: frozen, hashable, checked on construction.

    `Config(bounds)` and `Config.default(bounds)` are the same. `Config.paper` has the numbers of
    HIO-SDF (arXiv 2310.09463; sections in brackets), `Config.light` suits two CPU cores.

    Attributes:
        bounds: Corners ((x0, y0, z0), (x1, y1, z1)) of the mapped box, m, world frame. The grid
            covers it with whole voxels; a voxel corner lies at the world's origin. Leave two voxels
            behind the outer walls: returns beyond the bounds leave no surface.
        voxel_size: Edge of a voxel, m [IV-B].

        Clouds:
        max_points: Rows of a cloud that one update uses. Larger clouds are drawn from at random,
            smaller ones padded, so that one compilation serves a whole stream [IV-C].
        min_range: Nearer returns are ignored, m.
        max_range: Farther returns only clear their ray up to this range, m.
        range_noise: (a, b) of the standard deviation a + b r^2 of a return at range r, m and 1/m.
            Hits are averaged with weight 1 / sigma^2. A return counts as a new thing if it lies
            three standard deviations and 1.5 voxels in front of known surfaces: 0.65 m at 9 m.
        min_in_range: A cloud with a smaller share of its returns between min_range and max_range
            changes nothing and raises `Flag.OUT_OF_RANGE`. With 0 its rays clear space. Outside
            jit, `update` warns if a smaller share of the returns in range lies in the bounds.
        most_refusals: Clouds in a row that are refused because they contradict the map; the next
            one is fused. With 0 all clouds are fused.

        Grid [IV-B]:
        min_hits: Hits that a voxel needs before its patch counts as surface.
        min_hit_ratio: A patch that fills its voxel is carved below this share
            hits / (hits + passes); smaller patches need less, by their area. Small patches of
            returns with little noise need 0.6 of that.
        evidence_limit: Rays that a voxel remembers; older evidence fades beyond that.
        vanish_scans: Scans that must look through most of a surface patch, without a hit between
            them, before it vanishes. Patches of few hits need fewer scans. A scan with rays through
            all of a patch counts 1.5 times, a scan with two rays through half of it 0.5 times.
        distance_horizon: Largest distance to a patch that the grid resolves, m; <= 127 voxels.
        frontier_horizon: Largest distance to unseen space that the grid resolves, m.

        Samples per update:
        near_samples: Grid samples where |sdf| < near_distance (the paper's N) [IV-B].
        far_samples: Grid samples in the rest of the observed map (M) [IV-B].
        near_distance: The paper's epsilon, m [IV-B].
        local_points: Points of the newest cloud whose rays are sampled (S) [IV-C].
        local_ray_samples: Stratified samples on each of these rays (Q) [IV-C].
        local_truncation: Samples reach this far behind the point, and are kept while their
            distance to the cloud is less (t), m [IV-C].
        local_max_range: Local samples use points nearer than this, m.

        Network [IV-A]:
        hidden_width: Width of the SIREN's layers.
        hidden_layers: Hidden layers after the input layer.
        frequency: The SIREN's omega_0.

        Training [IV-D]:
        sdf_weight: Weight of the L1 distance loss.
        eikonal_weight: Weight of the Eikonal loss.
        eikonal_every: The Eikonal loss uses every n-th sample, with another offset in each epoch.
        learning_rate: AdamW learning rate.
        weight_decay: AdamW weight decay.
        batches: Gradient steps per epoch, each on its share of the samples; the paper's full-batch
            training has 1.
        epochs: Epochs per update.
        warmup_epochs: Epochs per update during the first `warmup_updates` updates.
        warmup_updates: Number of warm-up updates.

        Queries:
        weight_average: Queries use a running average of the weights, in which the previous average
            has this share. With 0 they use the latest weights. Training never uses the average.
        grid_share: Share of the grid's distance in the answer where the grid has one. The network
            has the rest, and answers alone beyond the horizon. With 0 the network answers alone,
            as in the paper.

    Example:
        >>> config = hio.Config.light(bounds=((0, 0, 0), (10, 8, 3)), max_range=6.0)
    """

    bounds: Bounds
    voxel_size: float = _number(0.10, 1e-3, 10.0)

    # Clouds
    max_points: int = _number(50_000, 1, 10_000_000)
    min_range: float = _number(0.1, 0.0, 1e4)
    max_range: float = _number(20.0, 1e-3, 1e4)
    range_noise: tuple[float, float] = (0.005, 0.002)
    min_in_range: float = _number(0.01, 0.0, 1.0)
    most_refusals: int = _number(10, 0, 1_000_000)

    # Grid
    min_hits: int = _number(2, 1, 1_000)
    min_hit_ratio: float = _number(0.25, 0.0, 1.0)
    evidence_limit: float = _number(100.0, 1.0, 1000.0)
    vanish_scans: int = _number(3, 1, 30)
    distance_horizon: float = _number(3.0, 1e-3, 1e4)
    frontier_horizon: float = _number(1.0, 1e-3, 1e4)

    # Samples per update
    near_samples: int = _number(10_000, 1, 10_000_000)
    far_samples: int = _number(30_000, 1, 10_000_000)
    near_distance: float = _number(0.05, 1e-4, 1e3)
    local_points: int = _number(100, 1, 1_000_000)
    local_ray_samples: int = _number(20, 1, 10_000)
    local_truncation: float = _number(0.2, 1e-3, 1e3)
    local_max_range: float = _number(6.0, 1e-3, 1e4)

    # Network
    hidden_width: int = _number(128, 1, 4_096)
    hidden_layers: int = _number(4, 1, 64)
    frequency: float = _number(10.0, 1e-3, 1e3)

    # Training
    sdf_weight: float = _number(5.0, 0.0, 1e6)
    eikonal_weight: float = _number(0.5, 0.0, 1e6)
    eikonal_every: int = _number(4, 1, 1_000)
    learning_rate: float = _number(4e-4, 0.0, 1.0)
    weight_decay: float = _number(0.012, 0.0, 1.0)
    batches: int = _number(1, 1, 10_000)
    epochs: int = _number(10, 1, 100_000)
    warmup_epochs: int = _number(50, 1, 100_000)
    warmup_updates: int = _number(5, 0, 1_000_000)

    # Queries
    weight_average: float = _number(0.9, 0.0, 0.999)
    grid_share: float = _number(0.9, 0.0, 1.0)

    def __new__(cls, *_: Any, **fields: Any) -> Self:
        """Refuses unknown fields by a ValueError, as all other wrong arguments."""
        unknown = sorted(set(fields) - set(cls.__dataclass_fields__))
        if unknown:
            similar = difflib.get_close_matches(unknown[0], cls.__dataclass_fields__, 1)
            hint = f"; did you mean {similar[0]!r}?" if similar else ""
            raise ValueError(f"Config has no field {unknown[0]!r}{hint}")
        return super().__new__(cls)

    def __post_init__(self) -> None:
        object.__setattr__(self, "bounds", _checked_bounds(self.bounds))
        noise = self.range_noise
        pair = as_real("Config.range_noise", noise)
        if pair.shape != (2,):
            raise ValueError(f"Config.range_noise is {noise!r}, expected two numbers (a, b)")
        floor, growth = float(pair[0]), float(pair[1])
        if not (1e-6 <= floor <= _MOST_NOISE and 0 <= growth <= _MOST_NOISE):
            raise ValueError(
                f"Config.range_noise is {noise!r}, expected a from 1e-6 to {_MOST_NOISE:g} m and "
                f"b from 0 to {_MOST_NOISE:g} 1/m"
            )
        object.__setattr__(self, "range_noise", (floor, growth))
        for field in dataclasses.fields(self):
            if "limits" not in field.metadata:
                continue
            name, whole = field.name, field.type == "int"
            value, (low, high) = getattr(self, name), field.metadata["limits"]
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
        if self.max_range <= self.min_range:
            raise ValueError(
                f"Config.max_range is {self.max_range!r}, expected more than min_range, "
                f"{self.min_range!r}"
            )
        if self.min_hits > self.evidence_limit:
            raise ValueError(
                f"Config.min_hits is {self.min_hits!r}, expected at most evidence_limit, "
                f"{self.evidence_limit!r}: no voxel would remember enough hits"
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
                f"Config.batches is {self.batches!r}, expected at most one per sample, {samples}"
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
    def default(cls, bounds: Any, **overrides: Any) -> Config:
        """Returns the best configuration for a GPU: grid and network answer together.

        The blend is more accurate than either. The grid's patches are also more accurate than the
        newest cloud alone, so few local samples are needed. On an H100 over the streams of the
        benchmarks, half of the paper's width and a quarter of the slopes cost 0.01 cm and halve
        the time of an update.

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and limits.
        """
        return cls(bounds, **overrides)

    @classmethod
    def paper(cls, bounds: Any, **overrides: Any) -> Config:
        """Returns the paper's network, samples and schedule; the network answers alone.

        It changes these fields of the default:

        - samples per update: local_points=1_000
        - network: hidden_width=256
        - training: eikonal_weight=2.0, eikonal_every=1
        - queries: grid_share=0.0

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and limits.
        """
        return cls(bounds, **(_PAPER | overrides))

    @classmethod
    def light(cls, bounds: Any, **overrides: Any) -> Config:
        """Returns the same pipeline, sized for two CPU cores.

        It changes these fields of the default:

        - clouds: max_points=36_000
        - samples per update: near_samples=8_000, far_samples=24_000, local_ray_samples=10
        - network: hidden_layers=2
        - training: eikonal_every=2, learning_rate=1e-3, batches=8, epochs=1, warmup_epochs=5
        - queries: weight_average=0.8

        Args:
            bounds: ((x0, y0, z0), (x1, y1, z1)), m, world frame.
            **overrides: Any other field of `Config`.

        Returns:
            The configuration.

        Raises:
            ValueError: A value is out of range; the message names field, value and limits.
        """
        return cls(bounds, **(_LIGHT | overrides))

    @property
    def corner_index(self) -> tuple[int, int, int]:
        """World index of the grid's first voxel; its corner is at corner_index * voxel_size, m."""
        low, _ = self._voxel_bounds()
        return low

    @property
    def grid_shape(self) -> tuple[int, int, int]:
        """Voxels along x, y and z."""
        low, high = self._voxel_bounds()
        return (high[0] - low[0], high[1] - low[1], high[2] - low[2])

    @property
    def horizon_voxels(self) -> int:
        """The distance horizon in whole voxels, rounded up."""
        return math.ceil(self.distance_horizon / self.voxel_size - _TOLERANCE_VOXELS)

    @property
    def frontier_voxels(self) -> int:
        """The frontier's horizon in whole voxels, rounded up."""
        return math.ceil(self.frontier_horizon / self.voxel_size - _TOLERANCE_VOXELS)

    def _voxel_bounds(self) -> tuple[tuple[int, int, int], tuple[int, int, int]]:
        (x0, y0, z0), (x1, y1, z1) = self.bounds

        def down(value: float) -> int:
            return math.floor(value / self.voxel_size + _TOLERANCE_VOXELS)

        def up(value: float) -> int:
            return math.ceil(value / self.voxel_size - _TOLERANCE_VOXELS)

        return (down(x0), down(y0), down(z0)), (up(x1), up(y1), up(z1))


# Differences from the default.
_PAPER: dict[str, Any] = {
    "local_points": 1_000,
    "hidden_width": 256,
    "eikonal_weight": 2.0,
    "eikonal_every": 1,
    "grid_share": 0.0,
}

_LIGHT: dict[str, Any] = {
    "max_points": 36_000,
    "near_samples": 8_000,
    "far_samples": 24_000,
    "local_ray_samples": 10,
    "hidden_layers": 2,
    "eikonal_every": 2,
    "learning_rate": 1e-3,
    "batches": 8,
    "epochs": 1,
    "warmup_epochs": 5,
    "weight_average": 0.8,
}


# Editors show this signature. `__new__` itself takes anything, so that its message can name it.
Config.__new__.__dict__["__signature__"] = inspect.signature(Config.__init__)


def _checked_bounds(bounds: Any) -> Bounds:
    corners = as_real("Config.bounds", bounds)
    if corners.shape != (2, 3):
        raise ValueError(
            f"Config.bounds is {bounds!r}, expected two corners ((x0, y0, z0), (x1, y1, z1))"
        )
    low, high = corners.astype(float).tolist()
    for axis, least, greatest in zip("xyz", low, high, strict=True):
        if not (math.isfinite(least) and math.isfinite(greatest) and least < greatest):
            raise ValueError(
                f"Config.bounds has {axis} from {least} to {greatest}, expected finite, ascending"
            )
        if max(-least, greatest) > FARTHEST_M:
            raise ValueError(
                f"Config.bounds has {axis} from {least} to {greatest}, expected at most "
                f"{FARTHEST_M / 1000:g} km from the origin; are they in m?"
            )
    return (low[0], low[1], low[2]), (high[0], high[1], high[2])
