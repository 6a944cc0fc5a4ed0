"""The stereo network in PyTorch alone: an independent statement of what barchan trains and exports.

Weights go over both ways without conversion. Parameters have the names and shapes of the file, and the
configuration lies in the file's header under `barchan.config`, as JSON:

    net, config = load("run/weights.safetensors")
    net.eval()
    disparity, sigma, confidence = net(left, right)   # [B, 3, H, W] in 0..1 -> [B, 1, H, W] each
    ...                                               # net.train() for training: see StereoNet
    save(net, config, "mine.safetensors")             # barchan infer --model mine.safetensors

Without this module it takes two lines to read and two to write, with any `nn.Module` of these names:

    net.load_state_dict(safetensors.torch.load_file(path))
    config = json.loads(safetensors.safe_open(path, "pt").metadata()["barchan.config"])

    tensors = {name: p.detach().float().contiguous() for name, p in net.state_dict().items()}
    safetensors.torch.save_file(tensors, path, metadata={"barchan.config": json.dumps(config)})

barchan wants every tensor as float32, none missing and none besides.

Volumes are [B, C, D, H, W]. Their bins of disparity run from near to far: bin k of D holds disparity
D - 1 - k, in pixels of the volume's resolution.
"""

import json
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

CONFIG_KEY = "barchan.config"
SCALE = 4
"""Pixels of the image per bin, and per pixel of the volume."""
CENSUS = 2
"""Census costs in a volume: at the whole bin, and half a bin further."""


def load(path: Path) -> tuple:
    """The network of a file, and its configuration."""
    with safe_open(path, "pt") as file:
        config = json.loads(file.metadata()[CONFIG_KEY])
    net = StereoNet(config)
    net.load_state_dict(load_file(path))
    return net, config


def save(net: nn.Module, config: dict, path: Path) -> None:
    """Writes a file that barchan reads."""
    tensors = {name: p.detach().float().contiguous() for name, p in net.state_dict().items()}
    save_file(tensors, path, metadata={CONFIG_KEY: json.dumps(config)})


class StereoNet(nn.Module):
    """Rectified pair in; disparity, its standard deviation (both pixels) and confidence out.

    In training mode the disparity is the mean over all bins, so that every bin gets a gradient; in
    evaluation mode the mean around the most probable bin.
    """

    def __init__(self, config: dict):
        super().__init__()
        self.bins = config["max_disparity"] // SCALE
        channels = config["features"]
        self.features = Features(channels)
        (kind, aggregation), = config["aggregation"].items()
        self.aggregation = {"planar": Planar, "volumetric": Volumetric}[kind](aggregation, channels)
        self.spread = config.get("spread", [0, 1, 0])
        hidden = config.get("refinement", 0)
        self.refinement = Refinement(channels[1], hidden) if hidden else None
        self.regression = Regression(channels[1], config["up_sampling"])

    def forward(self, left: Tensor, right: Tensor) -> tuple:
        height, width = left.shape[2:]
        images = F.instance_norm(torch.cat([left, right]), eps=1e-5)
        images = F.pad(images, (0, -width % 16, 0, -height % 16), mode="replicate")

        quarter, eighth = self.features(images)
        logits = self.aggregation(quarter.chunk(2), eighth.chunk(2), images.chunk(2), self.bins)
        full = self.regression(logits, quarter.chunk(2)[0], self.refinement)
        disparity, sigma, confidence = (x[:, :, :height, :width] for x in full)
        c, a, b = self.spread
        variance = (sigma / SCALE) ** 2
        return disparity, SCALE * (c + a * variance + b * variance**2).sqrt(), confidence


class Features(nn.Module):
    """What a pixel looks like, at 1/4 and 1/8: down to 1/16 and back up with shortcuts."""

    def __init__(self, channels: list):
        super().__init__()
        half, quarter, eighth, sixteenth = channels
        self.stem = nn.Conv2d(3, half, 3, 2, 1)
        self.quarter = nn.Conv2d(half, quarter, 3, 2, 1)
        self.quarter_more = nn.Conv2d(quarter, quarter, 3, 1, 1)
        self.eighth = nn.Conv2d(quarter, eighth, 3, 2, 1)
        self.eighth_more = nn.Conv2d(eighth, eighth, 3, 1, 1)
        self.sixteenth = nn.Conv2d(eighth, sixteenth, 3, 2, 1)
        self.sixteenth_more = nn.Conv2d(sixteenth, sixteenth, 3, 1, 1)
        self.up_eighth = nn.Conv2d(sixteenth, eighth, 1)
        self.up_quarter = nn.Conv2d(eighth, quarter, 1)

    def forward(self, image: Tensor) -> tuple:
        half = F.relu(self.stem(image))
        quarter = F.relu(self.quarter_more(F.relu(self.quarter(half))))
        eighth = F.relu(self.eighth_more(F.relu(self.eighth(quarter))))
        sixteenth = F.relu(self.sixteenth_more(F.relu(self.sixteenth(eighth))))
        eighth = F.relu(eighth + F.interpolate(self.up_eighth(sixteenth), scale_factor=2))
        quarter = F.relu(quarter + F.interpolate(self.up_quarter(eighth), scale_factor=2))
        return quarter, eighth


def shifted(x: Tensor, by: int) -> Tensor:
    """`x` moved right by so many columns, zeros moving in."""
    return F.pad(x, (by, 0, 0, 0))[..., : x.shape[-1]]


def volume(cost, right: Tensor, bins: int) -> Tensor:
    """`cost` of the right map shifted by every disparity, near to far, as [B, C, D, H, W]."""
    return torch.stack([cost(shifted(right, d)) for d in reversed(range(bins))], dim=2)


def correlation(left: Tensor, right: Tensor, groups: int, bins: int) -> Tensor:
    """Products of left and right features, summed over the channels of each group."""
    return volume(lambda r: (left * r).unflatten(1, (groups, -1)).sum(2), right, bins)


def census_costs(left: Tensor, right: Tensor, bins: int) -> Tensor:
    """Agreement of local order in both images, at every bin and at half a bin further; nothing is learned."""

    def local_mean(x: Tensor) -> Tensor:
        return F.avg_pool2d(F.pad(x, (2, 2, 2, 2), mode="replicate"), 5, 1)

    def normalised(image: Tensor) -> Tensor:
        grey = F.avg_pool2d(image, 2).mean(1, keepdim=True)
        centred = grey - local_mean(grey)
        return centred / (local_mean(centred**2) + 2e-4).sqrt()

    def descriptor(x: Tensor, shift: int) -> Tensor:
        """Opposite neighbours in a 5x5 window, `shift` pixels of half the resolution further left."""
        height, width = x.shape[2:]
        padded = F.pad(x, (2 + shift, 2, 2, 2), mode="replicate")[..., : width + 4]
        window = F.unfold(padded, 5)
        pairs = (2 * (window - window.flip(1))[:, :12]).clamp(-1, 1)
        # The 2x2 pixels of half the resolution that make one of a quarter.
        quarter = F.pixel_unshuffle(pairs.unflatten(2, (height, width)), 2)
        return quarter / quarter.shape[1] ** 0.5

    left, right = normalised(left), normalised(right)
    left, whole, half = descriptor(left, 0), descriptor(right, 0), descriptor(right, 1)
    return torch.cat([correlation(left, r, 1, bins) for r in (whole, half)], dim=1)


class PerBin(nn.Conv2d):
    """A convolution over height and width of `merges` bins at a time, as many bins apart.

    Bins pass as a batch, because PyTorch runs 2-D convolutions faster on a CPU than 3-D ones of depth 1.
    """

    def __init__(self, channels: int, out: int, size: int, stride: int = 1, merges: int = 1):
        super().__init__(merges * channels, out, size, stride, size // 2)
        self.merges = merges

    def forward(self, x: Tensor) -> Tensor:
        batch = x.shape[0]
        # [B, C, D, H, W] to [B * D / merges, merges * C, H, W] and back.
        bins = x.unflatten(2, (-1, self.merges)).permute(0, 2, 3, 1, 4, 5).flatten(2, 3).flatten(0, 1)
        return super().forward(bins).unflatten(0, (batch, -1)).transpose(1, 2)


class DisparityMix(nn.Conv1d):
    """A convolution over disparity alone, at every pixel."""

    def __init__(self, channels: int, out: int, size: int):
        super().__init__(channels, out, size, padding=size // 2)

    def forward(self, x: Tensor) -> Tensor:
        y = F.conv2d(x.flatten(3), self.weight[..., None], self.bias, padding=(*self.padding, 0))
        return y.unflatten(3, x.shape[3:])


def unfold_channels(x: Tensor, bins: int, rows: int, columns: int) -> Tensor:
    """Channels (bins, out, rows, columns) to so many times the disparities, height and width."""
    x = x.unflatten(1, (bins, -1, rows, columns))
    # [B, bins, C, rows, columns, D, H, W] to [B, C, D, bins, H, rows, W, columns]
    x = x.permute(0, 2, 5, 1, 6, 3, 7, 4)
    return x.flatten(6, 7).flatten(4, 5).flatten(2, 3)


class Block(nn.Module):
    def __init__(self, channels: int):
        super().__init__()
        self.spatial = PerBin(channels, channels, 3)
        self.mix = DisparityMix(channels, channels, 5)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(x + self.mix(F.relu(self.spatial(x))))


class Finest(nn.Module):
    """What 1/4 of the resolution adds to the logits; two bins at a time."""

    def __init__(self, channels: int, wide: int, raw: int, context: int):
        super().__init__()
        self.up = PerBin(wide, 4 * channels, 1)
        self.raw = PerBin(raw, channels, 1, merges=2)
        self.around = PerBin(channels, channels, 3)
        self.gate = nn.Conv2d(context, channels, 1)
        self.out = DisparityMix(channels, 2, 3)

    def forward(self, x: Tensor, raw: Tensor, seen: Tensor) -> Tensor:
        x = F.relu(unfold_channels(self.up(x), 1, 2, 2) + self.raw(raw))
        x = F.relu(x + self.around(x)) * self.gate(seen).sigmoid().unsqueeze(2)
        return unfold_channels(self.out(x), 2, 1, 1)


class Planar(nn.Module):
    """Presets tiny and rover: correlation, an encoder-decoder of split 3-D convolutions over 1/8 and 1/16,
    and beside it one linear mix of the raw costs."""

    def __init__(self, config: dict, features: list):
        super().__init__()
        _, quarter, eighth, _ = features
        match4, match8 = config["matching"]
        self.groups4, self.groups8 = config["groups"]
        wide, deep = config["channels"]
        encoder, bottom, decoder = config["blocks"]
        raw = self.groups4 + CENSUS
        self.match_quarter = nn.Conv2d(quarter, match4, 1)
        self.match_eighth = nn.Conv2d(eighth, match8, 3, 1, 1)
        self.down_eighth = PerBin(raw, wide, 3, stride=2, merges=2)
        self.join_eighth = PerBin(self.groups8, wide, 1)
        self.encoder = nn.Sequential(*[Block(wide) for _ in range(encoder)])
        self.down_sixteenth = PerBin(wide, deep, 3, stride=2, merges=2)
        self.bottom = nn.Sequential(*[Block(deep) for _ in range(bottom)])
        self.up_eighth = PerBin(deep, 2 * wide, 1)
        self.gate = nn.Conv2d(eighth, wide, 1)
        self.decoder = nn.Sequential(*[Block(wide) for _ in range(decoder)])
        self.out = DisparityMix(wide, 8, 3)
        self.finest = Finest(config.get("finest", 0), wide, raw, quarter) if config.get("finest", 0) else None
        self.matching = DisparityMix(raw, 1, 3)

    def forward(self, quarter: tuple, eighth: tuple, images: tuple, bins: int) -> Tensor:
        def unit(x: Tensor) -> Tensor:
            return x / (x.square().sum(1, keepdim=True) + 1e-6).sqrt()

        left4, right4 = (unit(self.match_quarter(x)) for x in quarter)
        left8, right8 = (unit(self.match_eighth(x)) for x in eighth)
        learned = correlation(left4, right4, self.groups4, bins)
        raw = torch.cat([learned, census_costs(*images, bins)], dim=1)
        coarse = correlation(left8, right8, self.groups8, bins // 2)

        x = self.encoder(F.relu(self.down_eighth(raw) + self.join_eighth(coarse)))
        y = self.bottom(F.relu(self.down_sixteenth(x)))
        y = F.interpolate(unfold_channels(self.up_eighth(y), 2, 1, 1), scale_factor=(1, 2, 2))
        # What the left image shows decides which of the costs count there.
        gate = self.gate(eighth[0]).sigmoid().unsqueeze(2)
        x = self.decoder(F.relu(y + x) * gate)
        logits = unfold_channels(self.out(x), 2, 2, 2) + self.matching(raw)
        if self.finest is not None:
            logits = logits + self.finest(x, raw, quarter[0])
        return logits.squeeze(1)


class Volumetric(nn.Module):
    """Preset paper: features side by side, an encoder-decoder of 3-D convolutions over 1/4, 1/8 and 1/16,
    and beside it, with census costs, one linear convolution of the volume."""

    def __init__(self, config: dict, features: list):
        super().__init__()
        matching = config["matching"]
        wide, middle, deep = config["channels"]
        raw = 2 * matching + (CENSUS if config["census"] else 0)
        self.match_quarter = nn.Conv2d(features[1], matching, 3, 1, 1)
        self.quarter = nn.Conv3d(raw, wide, 3, 1, 1)
        self.quarter_more = nn.Conv3d(wide, wide, 3, 1, 1)
        self.eighth = nn.Conv3d(wide, middle, 3, 2, 1)
        self.eighth_more = nn.Conv3d(middle, middle, 3, 1, 1)
        self.sixteenth = nn.Conv3d(middle, deep, 3, 2, 1)
        self.sixteenth_more = nn.Conv3d(deep, deep, 3, 1, 1)
        self.up_eighth = nn.ConvTranspose3d(deep, middle, 4, 2, 1)
        self.up_quarter = nn.ConvTranspose3d(middle, wide, 4, 2, 1)
        self.out = nn.Conv3d(wide, 1, 3, 1, 1)
        self.matching = nn.Conv3d(raw, 1, (3, 1, 1), 1, (1, 0, 0)) if config["census"] else None

    def forward(self, quarter: tuple, eighth: tuple, images: tuple, bins: int) -> Tensor:
        left, right = map(self.match_quarter, quarter)
        costs = volume(lambda r: torch.cat([left, r], dim=1), right, bins)
        if self.matching is not None:
            costs = torch.cat([costs, census_costs(*images, bins)], dim=1)

        high = F.relu(self.quarter_more(F.relu(self.quarter(costs))))
        middle = F.relu(self.eighth_more(F.relu(self.eighth(high))))
        deep = F.relu(self.sixteenth_more(F.relu(self.sixteenth(middle))))
        middle = F.relu(middle + self.up_eighth(deep))
        high = F.relu(high + self.up_quarter(middle))
        logits = self.out(high)
        if self.matching is not None:
            logits = logits + self.matching(costs)
        return logits.squeeze(1)


def mix(x: Tensor, weights: Tensor, reach: int) -> Tensor:
    """3x3 neighbours of a map, `reach` pixels apart, mixed; `weights` are [B, 9, n, H, W] and sum to one."""
    around = F.unfold(F.pad(x, (reach,) * 4, mode="replicate"), 3, dilation=reach)
    return (weights * around.unflatten(2, x.shape[2:]).unsqueeze(2)).sum(1)


def shares(logits: Tensor, of: int) -> Tensor:
    """Weights of 3x3 neighbours in each of `of` mixtures."""
    weights = logits.sigmoid().unflatten(1, (9, of))
    return weights / (weights.sum(1, keepdim=True) + 1e-12)


class Refinement(nn.Module):
    """Answers mixed from those further and further in: by whom, the image and the answers tell."""

    REACHES = (4, 2, 1)

    def __init__(self, context: int, hidden: int):
        super().__init__()
        self.image = nn.Conv2d(context, hidden, 3, 1, 1)
        self.answer = nn.Conv2d(2, hidden, 3, 1, 1)
        self.down = nn.Conv2d(hidden, hidden, 3, 2, 1)
        self.down_more = nn.Conv2d(hidden, hidden, 3, 1, 1)
        self.up = nn.Conv2d(hidden, context, 1)
        self.across = nn.Conv2d(hidden, context, 1)
        self.weights = nn.ModuleList(nn.Conv2d(context, 9, 1) for _ in self.REACHES)

    def forward(self, moments: tuple, context: Tensor) -> tuple:
        answer, _, confidence = moments
        high = F.relu(self.image(context) + self.answer(torch.cat([answer / 4, confidence], dim=1)))
        low = F.relu(self.down_more(F.relu(self.down(high))))
        features = F.relu(context + F.interpolate(self.up(low), scale_factor=2) + self.across(high))
        for reach, layer in zip(self.REACHES, self.weights):
            weights = shares(layer(features), 1)
            moments = tuple(mix(x, weights, reach) for x in moments)
        return moments, features


class Regression(nn.Module):
    """From logits [B, D, H, W] to disparity, and to full resolution by mixing 3x3 neighbours with
    weights learned from the image."""

    def __init__(self, context: int, hidden: int):
        super().__init__()
        self.look = nn.Conv2d(context, hidden, 3, 1, 1)
        self.mix = nn.Conv2d(hidden, 9 * SCALE**2, 1)

    def forward(self, logits: Tensor, context: Tensor, refinement: nn.Module | None) -> tuple:
        probability = logits.softmax(1)
        disparity = torch.arange(logits.shape[1], device=logits.device).flip(0)[:, None, None]

        def mean(x: Tensor) -> Tensor:
            return (probability * x).sum(1, keepdim=True)

        expected = mean(disparity)
        centre = expected if self.training else disparity[:, 0, 0][logits.argmax(1, keepdim=True)]
        # 1 within a bin and a half, 0 from two and a half on.
        near = (2.5 - (disparity - centre).abs()).clamp(0, 1)
        confidence = mean(near)
        answer = expected if self.training else mean(near * disparity) / confidence
        # E k^2 about zero, of a distribution of mean `answer` and the whole distribution's spread about it.
        square = mean((disparity - answer) ** 2) + answer**2

        coarse = (answer, square, confidence)
        if refinement is not None:
            coarse, context = refinement(coarse, context)
        weights = shares(self.mix(F.relu(self.look(context))), SCALE**2)
        answer, square, confidence = (F.pixel_shuffle(mix(x, weights, 1), SCALE) for x in coarse)
        # A certain answer between two bins needs both, and has a variance that says nothing of doubt.
        share = answer - answer.floor()
        variance = square - answer**2 - share * (1 - share)
        sigma = variance.clamp(min=1.5e-4).sqrt()
        return SCALE * answer, SCALE * sigma, confidence
