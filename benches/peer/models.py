"""The models of a field: the coordinate network, and the linear model on a grid of voxels."""

import math
from itertools import pairwise

import torch
from torch import Tensor, nn

HIDDEN_LAYERS = 8
HIDDEN_WIDTH = 128
VOXEL_M = 2.0
SIGMA_M = 5.0
VARIATION_WEIGHT = 0.5
SMOOTHING = 1e-5


def build_network() -> nn.Sequential:
    """The coordinate network, point to flow, with Xavier-uniform weights and zero biases."""
    widths = [3] + [HIDDEN_WIDTH] * HIDDEN_LAYERS
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Linear(HIDDEN_WIDTH, 3))
    for layer in network:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    return network


class LinearModel(nn.Module):
    """Weights on a grid, smoothed by Gaussians along each axis, blended over the 8 vertices.

    The released code flattens the grid with the strides of a smaller one, and evaluates it at the
    origin of the distance transform. Both are mended here.
    """

    def __init__(self, source: Tensor) -> None:
        super().__init__()
        lowest, highest = source.amin(dim=0), source.amax(dim=0)
        self.origin = torch.floor(lowest / VOXEL_M - 1) * VOXEL_M
        end = torch.ceil(highest / VOXEL_M + 1) * VOXEL_M
        self.shape = [int(n) for n in torch.round((end - self.origin) / VOXEL_M).long() + 1]
        self.encodings = [self.encoding(count) for count in self.shape]
        bound = 1 / math.sqrt(3)
        self.weights = nn.Parameter(torch.empty(3, *self.shape).uniform_(-bound, bound))
        self.indices, self.blending = self.place(source)
        self.values = torch.zeros(0)

    @staticmethod
    def encoding(count: int) -> Tensor:
        """Gaussians between the vertices of an axis, over the largest length of a row."""
        at = torch.arange(count, dtype=torch.float64) * VOXEL_M
        gaussians = torch.exp(-0.5 * (at[:, None] - at[None, :]).square() / SIGMA_M**2)
        return (gaussians / gaussians.norm(dim=1).max()).float()

    def place(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The flat indices of the 8 vertices around each point, and their weights."""
        off = (points - self.origin).double()
        cell = torch.floor(off / VOXEL_M).long()
        near = off - cell * VOXEL_M

        def kernel(distance: Tensor) -> Tensor:
            return torch.exp(-0.25 * distance.square() / SIGMA_M**2)

        across = kernel(torch.tensor(VOXEL_M, dtype=torch.float64))
        whole = 1 - across.square()
        lower = (kernel(near) - kernel(VOXEL_M - near) * across) / whole
        upper = (kernel(VOXEL_M - near) - kernel(near) * across) / whole
        indices, blending = [], []
        for corner in range(8):
            up = torch.tensor([corner & 1, corner >> 1 & 1, corner >> 2])
            x, y, z = (cell + up).unbind(dim=1)
            indices.append((x * self.shape[1] + y) * self.shape[2] + z)
            blending.append(torch.where(up.bool(), upper, lower).prod(dim=1))
        return torch.stack(indices), torch.stack(blending).float()

    def forward(self, _source: Tensor) -> Tensor:
        x, y, z = self.encodings
        values = torch.einsum("ai,cijk->cajk", x, self.weights)
        values = torch.einsum("bj,cajk->cabk", y, values)
        self.values = torch.einsum("dk,cabk->cabd", z, values)
        flat = self.values.flatten(start_dim=1)
        return (flat[:, self.indices] * self.blending).sum(dim=1).T

    def regularization(self) -> Tensor:
        """The weighted total variation of the displacements of the last forward pass."""
        inner = self.values[:, :-1, :-1, :-1]
        steps = (
            self.values[:, 1:, :-1, :-1] - inner,
            self.values[:, :-1, 1:, :-1] - inner,
            self.values[:, :-1, :-1, 1:] - inner,
        )
        lengths = torch.sqrt(SMOOTHING + sum(step.square() for step in steps))
        return VARIATION_WEIGHT * lengths.sum(dim=0).mean()
