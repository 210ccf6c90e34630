"""Recordings of the room in `room`, as .npz files of the three layouts."""

import dataclasses

import numpy as np
from room import BOUNDS, CONFIG, HALF

import hiosdf_jax as hio

BOX = ["--bounds", *map(str, np.ravel(BOUNDS)), "--max-range", str(CONFIG.max_range)]
RAYS = 250


def use_room_config(monkeypatch):
    """Makes Config.light that of the room: small, and compiled once for all tests."""

    def light(cls, bounds, **overrides):
        return dataclasses.replace(CONFIG, bounds=bounds, **overrides)

    monkeypatch.setattr(hio.Config, "light", classmethod(light))


def positions(frames):
    """The sensor's positions, (F, 3) m."""
    angle = 0.3 * np.arange(frames)
    return np.stack([0.4 * np.cos(angle), 0.3 * np.sin(angle), np.full(frames, 0.1)], axis=1)


def cast(origin, directions_world):
    """Distance along each ray to the walls of the room, (N,)."""
    with np.errstate(divide="ignore"):
        return np.where(
            directions_world > 0,
            (HALF - origin) / directions_world,
            (-HALF - origin) / directions_world,
        ).min(axis=-1)


def wall_sdf_and_grad(points):
    gaps = np.concatenate([points + HALF, HALF - points], axis=-1)
    nearest = gaps.argmin(axis=-1)
    return gaps.min(axis=-1), np.concatenate([np.eye(3), -np.eye(3)])[nearest]


def scan(frames):
    """Ranges (F, 250) of a LiDAR that turns about z, its directions and its poses."""
    directions = np.random.default_rng(0).normal(size=(RAYS, 3))
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    yaw = np.arange(frames)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(yaw), -np.sin(yaw)
    poses[:, :3, 3] = positions(frames)
    ranges = [cast(pose[:3, 3], directions @ pose[:3, :3].T) for pose in poses]
    return np.stack(ranges), directions, poses


def write_range(path, frames, truth=True):
    ranges, directions, poses = scan(frames)
    arrays = {"poses": poses, "range": ranges, "directions": directions, "range_scale": 1.0}
    if truth:
        rng = np.random.default_rng(1)
        share = rng.uniform(size=(500, 1))
        frame, ray = rng.integers(0, frames, 500), rng.integers(0, RAYS, 500)
        origins = poses[frame, :3, 3]
        world = np.einsum("nij,nj->ni", poses[frame, :3, :3], directions[ray])
        hits = origins + ranges[frame, ray, None] * world
        points = origins + share * (hits - origins)
        sdf, grad = wall_sdf_and_grad(points)
        arrays |= {"eval_visible": points, "eval_visible_sdf": sdf, "eval_visible_grad": grad}
        arrays |= {"eval_visible_frame": frame, "eval_surface": hits}
    np.savez(path, **arrays)
    return path


def write_points(path, frames, empty=(), bad=(), stray=(0, 0, 0)):
    """Scans in millimeters, each with one stray return; some of them empty or without a pose."""
    ranges, directions, poses = scan(frames)
    scans = [np.concatenate([each[:, None] * directions, [stray]]) for each in ranges]
    for i in empty:
        scans[i] = np.zeros((0, 3))
    poses[list(bad), 0, 0] = np.nan
    offsets = np.cumsum([0, *map(len, scans)])
    np.savez(
        path,
        poses=poses,
        points_mm=np.rint(1000 * np.concatenate(scans)).astype(np.int16),
        offsets=offsets,
    )
    return path


def write_depth(path, frames):
    """A camera that turns and looks down, in a world whose y points down."""
    height, width, focal = 24, 32, 14.0
    v, u = np.indices((height, width))
    rays = np.stack([(u - 15.5) / focal, (v - 11.5) / focal, np.ones_like(u)], -1).reshape(-1, 3)
    poses, depth = [], []
    tilted_from_room = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    for i, position in enumerate(positions(frames)):
        yaw, pitch = 0.6 * i, 0.5
        level = np.array([np.cos(yaw), np.sin(yaw), 0])
        forward = np.cos(pitch) * level - [0, 0, np.sin(pitch)]
        right = np.array([np.sin(yaw), -np.cos(yaw), 0])
        rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
        depth.append(cast(position, rays @ rotation.T).reshape(height, width))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = tilted_from_room @ rotation, tilted_from_room @ position
        poses.append(pose)
    matrix = [[focal, 0, 15.5], [0, focal, 11.5], [0, 0, 1]]
    raw = np.rint(1000 * np.stack(depth)).astype(np.uint16)
    np.savez(path, poses=poses, depth=raw, K=np.array(matrix), depth_scale=1000.0)
    return path
