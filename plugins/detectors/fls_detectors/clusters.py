"""Leader clustering: the strongest point draws those near it to itself."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fls_flow.kernels import compiled

__all__ = ["Clusters", "gathered", "leader_clusters"]

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]
BoolArray = npt.NDArray[np.bool_]


class Clusters(NamedTuple):
    """The cluster of each point, and what became of each cluster."""

    member_of: IntArray  # (n,) the cluster of each point
    leader: IntArray  # (n_clusters,) its strongest point, in the order of the points
    centre_m: FloatArray  # (n_clusters, 2) mean of its points

    def select(self, which: BoolArray) -> tuple[Clusters, BoolArray]:
        """The clusters that a mask selects, and the mask of the points that are in them."""
        points = which[self.member_of]
        cluster, point = np.cumsum(which) - 1, np.cumsum(points) - 1
        leader = point[self.leader[which]]
        return Clusters(cluster[self.member_of[points]], leader, self.centre_m[which]), points


def leader_clusters(position_m: FloatArray, radius_m: float, angle_rad: float = 0.0) -> Clusters:
    """Clusters of points (n, 2) in order of falling strength.

    Each point joins the nearest leader within `radius_m`, the stronger of equally near ones; else it leads.
    Across the leader's line of sight, at range r, the radius is r `angle_rad` if that is more: distances
    across are scaled down by the ratio.
    """
    farthest = float(np.hypot(position_m[:, 0], position_m[:, 1]).max()) if len(position_m) else 0.0
    return Clusters(*_lead(position_m, radius_m, angle_rad, max(radius_m, angle_rad * farthest)))


def gathered(
    clusters: Clusters, position_m: FloatArray, radius_m: float, angle_rad: float = 0.0
) -> tuple[Clusters, IntArray]:
    """The clusters of the points (n, 2), those one whose centres are one cluster, and what each went into.

    When the strongest point of an object lies at its side, what is left of it beyond the radius leads another
    cluster, and two tracks would share the object.
    """
    again = leader_clusters(clusters.centre_m, radius_m, angle_rad)
    member_of, n = again.member_of[clusters.member_of], again.leader.size
    total = np.stack([np.bincount(member_of, position_m[:, axis], n) for axis in (0, 1)], axis=1)
    centre_m = total / np.bincount(member_of, minlength=n)[:, None]
    return Clusters(member_of, clusters.leader[again.leader], centre_m), again.member_of


@compiled
def _lead(
    position_m: FloatArray, radius_m: float, angle_rad: float, side_m: float
) -> tuple[IntArray, IntArray, FloatArray]:
    """Leaders are chained by hashed squares of `side_m`: nine squares hold all that can be near."""
    n = position_m.shape[0]
    mask = 1
    while mask < 2 * n:
        mask *= 2
    mask -= 1
    head = np.full(mask + 1, -1, np.int64)
    following = np.empty(n, np.int64)  # next leader in the chain of each leader
    leader = np.empty(n, np.int64)
    member_of = np.empty(n, np.int64)
    total, size = np.zeros((n, 2)), np.zeros(n)
    count = 0
    for i in range(n):
        x, y = position_m[i]
        column, row = int(np.floor(x / side_m)), int(np.floor(y / side_m))
        nearest, best = -1, radius_m * radius_m
        for dc in range(-1, 2):
            for dr in range(-1, 2):
                k = head[((column + dc) * 73856093 ^ (row + dr) * 19349663) & mask]
                while k >= 0:
                    square = _square_distance(position_m[i], position_m[leader[k]], radius_m, angle_rad)
                    if square < best or (square == best and (nearest < 0 or k < nearest)):
                        nearest, best = k, square
                    k = following[k]
        if nearest < 0:
            nearest = count
            slot = (column * 73856093 ^ row * 19349663) & mask
            leader[count], following[count], head[slot] = i, head[slot], count
            count += 1
        member_of[i] = nearest
        total[nearest, 0] += x
        total[nearest, 1] += y
        size[nearest] += 1.0
    for k in range(count):
        total[k] /= size[k]
    return member_of, leader[:count].copy(), total[:count].copy()


@compiled
def _square_distance(point_m: FloatArray, leader_m: FloatArray, radius_m: float, angle_rad: float) -> float:
    dx, dy = point_m[0] - leader_m[0], point_m[1] - leader_m[1]
    distance = np.hypot(leader_m[0], leader_m[1])
    if angle_rad * distance <= radius_m:
        return float(dx * dx + dy * dy)
    scale = radius_m / (angle_rad * distance)
    along = (dx * leader_m[0] + dy * leader_m[1]) / distance
    across = scale * (dy * leader_m[0] - dx * leader_m[1]) / distance
    return float(along * along + across * across)
