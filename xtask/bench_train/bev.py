"""What PointPillars and CenterPoint share in PyTorch: pillar feature net, canvas, backbone and neck, made-up inputs.

As OpenPCDet runs it: pillars padded to their full number of points, images NCHW. `best`: the points alone with the padding's exact share in
the statistics, images channels-last.
"""

import torch
import torch.nn.functional as F
from torch import nn

INPUTS_BESIDE_CHANNELS = 6  # offsets of a point from its pillar's mean and centre


class PillarNet(nn.Module):
    def __init__(self, inputs, filters, max_points):
        super().__init__()
        self.linear = nn.Linear(inputs, filters, bias=False)
        self.norm = nn.BatchNorm1d(filters, eps=1e-3, momentum=0.01)
        self.max_points = max_points

    def padded(self, x):  # [P, M, F] -> [P, C]
        y = self.linear(x)
        y = self.norm(y.permute(0, 2, 1)).permute(0, 2, 1)
        return F.relu(y).max(dim=1)[0]

    def of_points(self, x, pillar, pillars):  # [N, F] -> [P, C]
        y = self.linear(x)
        rows = pillars * self.max_points
        mean = y.sum(0) / rows
        variance = (y.square().sum(0) / rows - mean.square()).clamp(min=0)
        with torch.no_grad():
            self.norm.running_mean.lerp_(mean, 0.01)
            self.norm.running_var.lerp_(variance * rows / (rows - 1), 0.01)
        scale = self.norm.weight * torch.rsqrt(variance + self.norm.eps)
        y = F.relu(torch.addcmul(self.norm.bias - mean * scale, y, scale))
        empty = F.relu(self.norm.bias - mean * scale)
        out = empty.expand(pillars, -1).clone()
        return out.scatter_reduce(0, pillar[:, None].expand(-1, y.shape[1]), y, "amax", include_self=True)


class Encoder(nn.Module):
    """All in front of the head but the pillar feature net."""

    def __init__(self, config, filters):
        super().__init__()
        net = config["network"]
        size, extent = net["pillars"]["size_m"], config["range_m"]
        self.nx, self.ny = (round((extent[3 + i] - extent[i]) / size[i]) for i in range(2))
        norm = lambda channels: nn.BatchNorm2d(channels, eps=1e-3, momentum=0.01)
        backbone = net["backbone"]
        self.blocks, self.deblocks = nn.ModuleList(), nn.ModuleList()
        before = filters
        for i, filters in enumerate(backbone["filters"]):
            strides = [backbone["strides"][i]] + [1] * backbone["layers"][i]
            layers = []
            for stride in strides:
                layers += [nn.Conv2d(before, filters, 3, stride, 1, bias=False), norm(filters), nn.ReLU()]
                before = filters
            self.blocks.append(nn.Sequential(*layers))
            up, up_filters = int(backbone["upsample_strides"][i]), backbone["upsample_filters"][i]
            deconv = nn.ConvTranspose2d(filters, up_filters, up, up, bias=False)
            self.deblocks.append(nn.Sequential(deconv, norm(up_filters), nn.ReLU()))
        self.neck = sum(backbone["upsample_filters"])

    def canvas(self, features, cells, batch, best):
        channels = features.shape[1]
        if best:
            canvas = features.new_zeros(batch * self.ny * self.nx, channels).index_put((cells,), features)
            return canvas.view(batch, self.ny, self.nx, channels).permute(0, 3, 1, 2)
        frames = []
        for frame in range(batch):
            of_frame = cells // (self.ny * self.nx) == frame
            canvas = features.new_zeros(channels, self.ny * self.nx)
            canvas[:, cells[of_frame] - frame * self.ny * self.nx] = features[of_frame].t()
            frames.append(canvas)
        return torch.stack(frames).view(batch, channels, self.ny, self.nx)

    def features(self, x):
        ups = []
        for block, deblock in zip(self.blocks, self.deblocks):
            x = block(x)
            ups.append(deblock(x))
        return torch.cat(ups, dim=1)


def make_points(config, points, pillars):
    """As many points in each pillar as the total allows, at least one: padded pillars, points alone, the pillar of each."""
    max_points = config["network"]["pillars"]["max_points"]
    inputs = config["channels"] + INPUTS_BESIDE_CHANNELS
    num_points = torch.ones(pillars, dtype=torch.long)
    share = torch.rand(pillars).pow(4)
    num_points += (share / share.sum() * (points - pillars)).long().clamp(max=max_points - 1)
    is_point = torch.arange(max_points)[None] < num_points[:, None]
    padded = torch.randn(pillars, max_points, inputs) * is_point[..., None]
    return padded, padded[is_point], torch.repeat_interleave(torch.arange(pillars), num_points)


def make_cells(batch, pillars, area):
    """Cells of the pillars, about as many in each frame, in the canvases laid end to end."""
    each = pillars // batch
    sizes = [each] * (batch - 1) + [pillars - each * (batch - 1)]
    return torch.cat([torch.randperm(area)[:n] + frame * area for frame, n in enumerate(sizes)])
