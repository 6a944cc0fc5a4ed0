"""barchan's training step as PyTorch has it: the losses of Hong 2021 and Adam, on the network in PyTorch."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


def self_supervised(left: Tensor, right: Tensor, disparity: Tensor) -> dict:
    """Eq. 1-5 with the paper's weights; what lies outside the right image cannot be judged and is left out."""
    height, width = left.shape[2:]
    columns, rows = torch.arange(width, dtype=torch.float32), torch.arange(height, dtype=torch.float32)
    seen_at = columns - disparity[:, 0]
    inside = ((seen_at >= 0) & (seen_at <= width - 1)).float()[:, None]
    along = 2 * seen_at / (width - 1) - 1
    down = (2 * rows / (height - 1) - 1)[:, None].expand_as(along)
    grid = torch.stack([along, down], dim=3)
    warped = F.grid_sample(right, grid, padding_mode="border", align_corners=True)

    share = disparity / width
    terms = {
        "ssim": masked_mean(structural_dissimilarity(left, warped), inside[:, :, 1:-1, 1:-1]),
        "l1": masked_mean((left - warped).abs(), inside),
        "smooth": edge_aware_smoothness(left, share),
        "magnitude": masked_mean(share.abs(), inside),
    }
    weights = {"ssim": 0.8, "l1": 0.2, "smooth": 0.1, "magnitude": 0.1}
    return {"loss": sum(weights[name] * term for name, term in terms.items()), **terms}


def supervised(disparity: Tensor, truth: Tensor, largest: float) -> Tensor:
    """Eq. 8 where truth is known (not NaN) and within reach."""
    known = truth <= largest
    return F.smooth_l1_loss(disparity[known], truth[known])


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    return (x * mask).sum() / (mask.sum() * x.shape[1] + 1e-6)


def structural_dissimilarity(a: Tensor, b: Tensor) -> Tensor:
    """(1 - SSIM) / 2 over 3x3 windows, eq. 2."""

    def mean(x: Tensor) -> Tensor:
        return F.avg_pool2d(x, 3, 1)

    mean_a, mean_b = mean(a), mean(b)
    variance_a, variance_b = mean(a * a) - mean_a**2, mean(b * b) - mean_b**2
    covariance = mean(a * b) - mean_a * mean_b
    c1, c2 = 0.01**2, 0.03**2
    ssim = (2 * mean_a * mean_b + c1) * (2 * covariance + c2)
    ssim = ssim / ((mean_a**2 + mean_b**2 + c1) * (variance_a + variance_b + c2))
    return ((1 - ssim) / 2).clamp(0, 1)


def edge_aware_smoothness(image: Tensor, disparity: Tensor) -> Tensor:
    """First differences of the disparity, forgiven where the image has an edge."""

    def along(dim: int) -> Tensor:
        edge = image.diff(dim=dim).abs().mean(1, keepdim=True)
        return (disparity.diff(dim=dim).abs() * (-10 * edge).exp()).mean()

    return along(3) + along(2)


class Trainer:
    """Adam with the gradient of all parameters together clipped to length 1."""

    def __init__(self, net: nn.Module, rate: float):
        self.net = net.train()
        self.optimizer = torch.optim.Adam(net.parameters(), lr=rate, eps=1e-8)

    def step(self, left: Tensor, right: Tensor, truth: Tensor = None) -> dict:
        """One step on images [B, 3, H, W], from true disparity where it is given; the losses before it."""
        disparity, _, _ = self.net(left, right)
        losses = self_supervised(left, right, disparity)
        if truth is not None:
            losses["loss"] = supervised(disparity, truth, 4 * self.net.bins - 2)
        self.optimizer.zero_grad()
        losses["loss"].backward()
        nn.utils.clip_grad_norm_(self.net.parameters(), 1.0)
        self.optimizer.step()
        return {name: loss.item() for name, loss in losses.items()}
