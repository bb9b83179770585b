"""The losses of a displaced source cloud: its distance transform, and the Chamfer distance."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

CELLS_PER_METRE = 10
CELL_M = 1 / CELLS_PER_METRE
TRUNCATION_M = 2.0
# Points whose distances to the other cloud are held at once.
ROWS_AT_ONCE = 4096

Loss = Callable[[Tensor], Tensor]
"""A displaced source cloud (N x 3) to its loss."""

Transform = Callable[[Tensor], Tensor]
"""Occupied vertices (bool, X x Y x Z) to the distance of every vertex to the nearest of them."""


def load_transform(name: str, threads: int) -> Transform:
    """Imports the package behind a transform now, so that no import falls into the timing."""
    return {"edt": load_edt, "fastgeodis": load_fastgeodis}[name](threads)


def load_edt(threads: int) -> Transform:
    """The exact Euclidean distance transform, which the paper describes; always on the CPU."""
    import edt

    def transform(occupied: Tensor) -> Tensor:
        empty = (~occupied).cpu().numpy()
        distances = edt.edt(empty, anisotropy=(CELL_M,) * 3, parallel=threads)
        return torch.from_numpy(distances).to(occupied.device)

    return transform


def load_fastgeodis(_threads: int) -> Transform:
    """The raster-scan transform that the published code calls: a chamfer metric, at most 13 % long.

    It runs on the occupied vertices' device, with torch's threads.
    """
    import FastGeodis

    def transform(occupied: Tensor) -> Tensor:
        empty = (~occupied).float()[None, None]
        image = torch.zeros_like(empty)
        return FastGeodis.generalised_geodesic3d(image, empty, [CELL_M] * 3, 1e10, 0.0, 1)[0, 0]

    return transform


class DistanceMap:
    """Distance to the rasterised target, on a dense grid that covers both clouds."""

    def __init__(self, source: Tensor, target: Tensor, transform: Transform) -> None:
        lowest = torch.minimum(source.amin(dim=0), target.amin(dim=0))
        highest = torch.maximum(source.amax(dim=0), target.amax(dim=0))
        self.origin = torch.floor(lowest * CELLS_PER_METRE - 1) / CELLS_PER_METRE
        end = torch.ceil(highest * CELLS_PER_METRE + 1) / CELLS_PER_METRE
        shape = torch.ceil((end - self.origin) * CELLS_PER_METRE).long() + 2
        self.first = torch.zeros_like(self.origin)
        self.last = (shape - 1).to(self.origin.dtype)

        vertices = torch.round((target - self.origin) * CELLS_PER_METRE).long()
        occupied = torch.zeros(shape.tolist(), dtype=torch.bool, device=target.device)
        occupied[vertices.unbind(dim=1)] = True
        self.distances = transform(occupied)[None, None]

    def __call__(self, points: Tensor) -> Tensor:
        """Mean trilinear distance of the points; an axis on which a point lies outside pulls nothing.

        The clamp, not the sampler's border mode, is what zeroes that axis of the gradient.
        """
        cells = (points - self.origin) * CELLS_PER_METRE
        inside = torch.clamp(cells, self.first, self.last)
        zyx = (2 * inside / self.last - 1).flip(dims=(1,))
        sampled = nn.functional.grid_sample(
            self.distances,
            zyx[None, :, None, None, :],
            mode="bilinear",
            padding_mode="border",
            align_corners=True,
        )
        return sampled.mean()


class Chamfer:
    """The truncated Chamfer distance: squared distances to nearest neighbors, both ways.

    Distances of at least 2 m count as zero and stay in the mean. Neighbors are found without
    gradients, by all distances or by k-d trees. The target's tree is built once.
    """

    def __init__(self, target: Tensor, trees: bool, threads: int) -> None:
        self.target = target
        self.threads = threads
        self.tree = self.build(target) if trees else None

    @staticmethod
    def build(points: Tensor):
        """A k-d tree of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(points.detach().cpu().numpy())

    @torch.no_grad()
    def neighbors(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """For each point its nearest target point, and for each target point its nearest point."""
        if self.tree is not None:
            _, forward = self.tree.query(points.cpu().numpy(), workers=self.threads)
            _, backward = self.build(points).query(self.target.cpu().numpy(), workers=self.threads)
            return torch.from_numpy(forward), torch.from_numpy(backward)
        nearest = [[], []]
        for found, own, other in (
            (nearest[0], points, self.target),
            (nearest[1], self.target, points),
        ):
            for rows in own.split(ROWS_AT_ONCE):
                # Differences, not products: at 50 m these lose centimetres in single precision.
                distances = torch.cdist(rows, other, compute_mode="donot_use_mm_for_euclid_dist")
                found.append(distances.argmin(dim=1))
        return torch.cat(nearest[0]), torch.cat(nearest[1])

    def __call__(self, points: Tensor) -> Tensor:
        forward, backward = self.neighbors(points)
        ahead = (points - self.target[forward]).square().sum(dim=1)
        back = (points[backward] - self.target).square().sum(dim=1)
        limit = TRUNCATION_M**2
        ahead = torch.where(ahead < limit, ahead, torch.zeros_like(ahead))
        back = torch.where(back < limit, back, torch.zeros_like(back))
        return ahead.mean() + back.mean()
