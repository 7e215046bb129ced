"""What the official CRA-PCN takes from its CUDA extensions, in plain PyTorch."""

import sys
import types

import torch

SKIPPED_SQUARE = 1e-3
"""Points at most this near to the origin, squared, are never sampled."""


def farthest_points(points, count, ties="cuda"):
    """Furthest point sampling of (B, N, 3): int32 rows (B, count).

    Starts at row 0. Of equally far points, ``ties="lowest"`` takes the first row;
    ``"cuda"`` takes the one that the extension's reduction leaves: threads are the
    largest power of two up to N, at most 512, and the first row of the thread with the
    smallest bit-reversed number wins.
    """
    total = points.shape[1]
    order = _reduction_order(total) if ties == "cuda" else torch.arange(total)
    skipped = points.square().sum(-1) <= SKIPPED_SQUARE
    nearest = points.new_full(points.shape[:2], 1e10)
    chosen = torch.zeros(len(points), count, dtype=torch.int64)
    rows = torch.arange(len(points))
    first_wins = torch.arange(total, 0, -1)
    for i in range(1, count):
        offsets = points - points[rows, chosen[:, i - 1]][:, None]
        nearest = torch.minimum(nearest, offsets.square().sum(-1))
        distances = nearest.masked_fill(skipped, -1)[:, order]
        farthest = distances == distances.max(1, keepdim=True)[0]
        found = order[(farthest * first_wins).argmax(1)]
        chosen[:, i] = torch.where(skipped.all(1), 0, found)
    return chosen.int()


def _reduction_order(total):
    """All rows, those first that win ties."""
    bits = min(9, total.bit_length() - 1)
    threads = 2**bits

    def key(row):
        return int(f"{row % threads:0{bits}b}"[::-1], 2), row

    return torch.tensor(sorted(range(total), key=key))


def gather_points(features, rows):
    """Columns ``rows`` (B, M) of (B, C, N)."""
    rows = rows.long()[:, None].expand(-1, features.shape[1], -1)
    return torch.gather(features, 2, rows)


def group_points(features, rows):
    """Columns ``rows`` (B, M, K) of (B, C, N), as (B, C, M, K)."""
    return gather_points(features, rows.flatten(1)).unflatten(2, rows.shape[1:])


class Chamfer(torch.nn.Module):
    """Squared distances to the nearest point, both ways, and where it is."""

    def forward(self, first, second):
        mode = "donot_use_mm_for_euclid_dist"
        with torch.no_grad():
            distances = torch.cdist(first, second, compute_mode=mode)
        to_second, to_first = distances.argmin(2), distances.argmin(1)
        nearest_second = gather_points(second.mT, to_second).mT
        nearest_first = gather_points(first.mT, to_first).mT
        forward = (first - nearest_second).square().sum(-1)
        backward = (second - nearest_first).square().sum(-1)
        return forward, backward, to_second, to_first


def _not_of_this_network(*_):
    raise NotImplementedError("CRA-PCN imports this and does not call it")


def install():
    """Puts the stand-ins where the official code imports its extensions from."""
    modules = {
        "pointnet2_ops": {},
        "pointnet2_ops.pointnet2_utils": {
            "furthest_point_sample": farthest_points,
            "gather_operation": gather_points,
            "grouping_operation": group_points,
            "ball_query": _not_of_this_network,
            "three_nn": _not_of_this_network,
            "three_interpolate": _not_of_this_network,
        },
        "Chamfer3D": {},
        "Chamfer3D.dist_chamfer_3D": {"chamfer_3DDist": Chamfer},
    }
    for name, members in modules.items():
        module = types.ModuleType(name)
        module.__dict__.update(members)
        sys.modules[name] = module
