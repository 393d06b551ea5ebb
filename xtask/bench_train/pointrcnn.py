"""A training step of PointRCNN (Shi et al. 2019): convolutions of 1x1 over groups filled up to their full size, as OpenPCDet runs it.

Sampling and neighbour search are compiled for the CPU by numba. Regions and their points are given, not searched for. On a GPU
neighbours are searched once, before the steps that are timed: all steps have the same points.
"""

import numba
import numpy as np
import torch
import torch.nn.functional as F
from torch import nn

PREFIX = 5  # position, score and distance of a pooled point
POINT_CODE = 8


@numba.njit(cache=True, fastmath=False)
def farthest(points, count):
    n = points.shape[0]
    picks = np.zeros(count, np.int64)
    distance = np.full(n, np.float32(1e10))
    last = 0
    for k in range(1, count):
        x, y, z = points[last, 0], points[last, 1], points[last, 2]
        best, at = np.float32(-1), 0
        for i in range(n):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            d = min(distance[i], dx * dx + dy * dy + dz * dz)
            distance[i] = d
            if d > best:
                best, at = d, i
        picks[k] = last = at
    return picks


@numba.njit(cache=True, parallel=True)
def ball(points, centers, radius, samples):
    out = np.zeros((centers.shape[0], samples), np.int64)
    for c in numba.prange(centers.shape[0]):
        x, y, z = centers[c, 0], centers[c, 1], centers[c, 2]
        found = 0
        for i in range(points.shape[0]):
            dx, dy, dz = points[i, 0] - x, points[i, 1] - y, points[i, 2] - z
            if dx * dx + dy * dy + dz * dz < radius * radius:
                if found == 0:
                    out[c, :] = i
                out[c, found] = i
                found += 1
                if found == samples:
                    break
    return out


@numba.njit(cache=True, parallel=True)
def nearest_three(points, known):
    index = np.zeros((points.shape[0], 3), np.int64)
    distance = np.zeros((points.shape[0], 3), np.float32)
    for p in numba.prange(points.shape[0]):
        best = np.full(3, np.float32(1e30))
        at = np.zeros(3, np.int64)
        for k in range(known.shape[0]):
            dx, dy, dz = points[p, 0] - known[k, 0], points[p, 1] - known[k, 1], points[p, 2] - known[k, 2]
            d = dx * dx + dy * dy + dz * dz
            if d < best[0]:
                best[2], best[1], best[0] = best[1], best[0], d
                at[2], at[1], at[0] = at[1], at[0], k
            elif d < best[1]:
                best[2], best[1] = best[1], d
                at[2], at[1] = at[1], k
            elif d < best[2]:
                best[2], at[2] = d, k
        index[p], distance[p] = at, best
    return index, distance


@numba.njit(cache=True, parallel=True)
def farthest_of_all(clouds, count):
    out = np.zeros((clouds.shape[0], count), np.int64)
    for b in numba.prange(clouds.shape[0]):
        out[b] = farthest(clouds[b], count)
    return out


@numba.njit(cache=True, parallel=True)
def ball_of_all(clouds, centers, radius, samples):
    out = np.zeros((clouds.shape[0], centers.shape[1], samples), np.int64)
    for b in numba.prange(clouds.shape[0]):
        out[b] = ball(clouds[b], centers[b], radius, samples)
    return out


def chain2d(channels):
    layers = []
    for a, b in zip(channels, channels[1:]):
        layers += [nn.Conv2d(a, b, 1, bias=False), nn.BatchNorm2d(b), nn.ReLU()]
    return nn.Sequential(*layers)


def chain1d(channels, last):
    layers = []
    for a, b in zip(channels, channels[1:]):
        layers += [nn.Linear(a, b, bias=False), nn.BatchNorm1d(b), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(channels[-1], last))


def once(module, key, on_gpu, search):
    """What `search` finds; on a GPU, what it found in the first step."""
    found = module.found.get(key)
    if found is None or not on_gpu:
        found = module.found[key] = search()
    return found


def on_host(tensor):
    return tensor.detach().cpu().numpy()


def rows(tensor, index):
    """`tensor`: [B, N, C], `index`: [B, ...]; result [B, ..., C]."""
    batch = torch.arange(tensor.shape[0], device=tensor.device).view(-1, *[1] * (index.dim() - 1))
    return tensor[batch, index]


def grouped(xyz, features, centers, index):
    """Offsets and features of neighbours, [B, 3 + C, M, S]; features: [B, C, N]."""
    offset = rows(xyz, index) - centers[:, :, None]
    of_groups = rows(features.transpose(1, 2), index)
    return torch.cat([offset, of_groups], dim=-1).permute(0, 3, 1, 2)


class SetAbstraction(nn.Module):
    def __init__(self, inputs, centers, scales):
        super().__init__()
        self.centers, self.scales, self.found = centers, scales, {}
        self.mlps = nn.ModuleList(chain2d([3 + inputs, *scale["filters"]]) for scale in scales)
        self.outputs = sum(scale["filters"][-1] for scale in scales)

    def search(self, xyz):
        to = lambda index: torch.from_numpy(index).to(xyz.device)
        picks = to(farthest_of_all(on_host(xyz), self.centers))
        centers = on_host(rows(xyz, picks))
        ball = lambda scale: ball_of_all(on_host(xyz), centers, np.float32(scale["radius_m"]), scale["samples"])
        return picks, [to(ball(scale)) for scale in self.scales]

    def forward(self, xyz, features):
        if self.centers is None:
            index = torch.arange(xyz.shape[1], device=xyz.device).expand(xyz.shape[0], 1, -1)
            centers = torch.zeros(xyz.shape[0], 1, 3, device=xyz.device)
            groups = [index]
        else:
            picks, groups = once(self, "groups", xyz.is_cuda, lambda: self.search(xyz))
            centers = rows(xyz, picks)
        out = [mlp(grouped(xyz, features, centers, g)).max(dim=-1)[0] for mlp, g in zip(self.mlps, groups)]
        return centers, torch.cat(out, dim=1)


class Network(nn.Module):
    def __init__(self, config):
        super().__init__()
        net, classes, self.found = config["network"], len(config["classes"]), {}
        inputs = [config["channels"] - 3]
        self.sa_modules = nn.ModuleList()
        for level in net["levels"]:
            module = SetAbstraction(inputs[-1], level["centers"], level["scales"])
            self.sa_modules.append(module)
            inputs.append(module.outputs)
        known, modules = inputs[-1], []
        for i in reversed(range(len(net["levels"]))):
            filters = net["propagation"][i]
            modules.insert(0, chain2d([known + inputs[i], *filters]))
            known = filters[-1]
        self.fp_modules = nn.ModuleList(modules)
        head, roi = net["point_head"], net["roi_head"]
        self.cls = chain1d([known, *head["class_filters"]], classes)
        self.box = chain1d([known, *head["box_filters"]], POINT_CODE)
        first, second = roi["xyz_filters"]
        self.xyz_up = nn.Sequential(nn.Conv2d(PREFIX, first, 1), nn.ReLU(), nn.Conv2d(first, second, 1), nn.ReLU())
        self.merge = nn.Sequential(nn.Conv2d(second + known, second, 1), nn.ReLU())
        self.roi_modules, before = nn.ModuleList(), second
        for level in roi["levels"]:
            module = SetAbstraction(before, level["centers"], [level])
            self.roi_modules.append(module)
            before = module.outputs
        self.roi_modules.append(SetAbstraction(before, None, [{"filters": roi["global_filters"]}]))
        before = roi["global_filters"][-1]
        self.roi_cls = chain1d([before, *roi["class_filters"]], 1)
        self.roi_box = chain1d([before, *roi["box_filters"]], 7)

    def nearest(self, points, known):
        found = [nearest_three(a, b) for a, b in zip(on_host(points), on_host(known))]
        return [torch.from_numpy(np.stack(part)).to(points.device) for part in zip(*found)]

    def points(self, xyz, values):
        """xyz: [B, N, 3], values: [B, C, N]; features of all points, [B, C', N]."""
        clouds, features = [xyz], [values]
        for module in self.sa_modules:
            centers, out = module(clouds[-1], features[-1])
            clouds.append(centers)
            features.append(out)
        known = features[-1]
        for i in reversed(range(len(self.fp_modules))):
            index, distance = once(self, i, xyz.is_cuda, lambda: self.nearest(clouds[i], clouds[i + 1]))
            weight = 1 / (distance.sqrt() + 1e-8)
            weight = weight / weight.sum(-1, keepdim=True)
            known = (rows(known.transpose(1, 2), index) * weight[..., None]).sum(2).transpose(1, 2)
            known = self.fp_modules[i](torch.cat([known, features[i]], dim=1)[..., None])[..., 0]
        return known

    def regions(self, prefix, features):
        """prefix: [R, S, 5], features: [R, S, C]."""
        up = self.xyz_up(prefix.transpose(1, 2)[..., None])
        features = self.merge(torch.cat([up, features.transpose(1, 2)[..., None]], dim=1))[..., 0]
        xyz = prefix[..., :3].contiguous()
        for module in self.roi_modules:
            xyz, features = module(xyz, features)
        return features[..., 0]


def smooth_l1(difference):
    n = difference.abs()
    return torch.where(n < 1 / 9, 4.5 * n.square(), n - 0.5 / 9)


def cloud(batch, n, extent):
    """Points as dense as a scan has them: many near, few far."""
    low, high = torch.tensor(extent[:3]), torch.tensor(extent[3:])
    reach = torch.minimum(high[0], -low[1] if low[0] >= 0 else high[0])
    range_m = reach * torch.rand(batch, n).square()
    azimuth = (torch.rand(batch, n) - 0.5) * (1.5 if low[0] >= 0 else 6.28)
    z = torch.rand(batch, n) * 2 - 2
    return torch.stack([range_m * azimuth.cos(), range_m * azimuth.sin(), z], dim=-1).contiguous()


def make_step(config, batch):
    """One step of `batch` frames."""
    net = config["network"]
    numba.set_num_threads(torch.get_num_threads())
    network = Network(config)
    n, regions = net["sampling"]["points"], net["roi_sampling"]["regions"]
    per_region = net["roi_head"]["points"]
    xyz = cloud(batch, n, config["range_m"])
    values = torch.rand(batch, config["channels"] - 3, n)
    positive = torch.rand(batch * n) < 0.03
    one_hot = torch.zeros(batch * n, len(config["classes"]))
    one_hot[positive, 0] = 1
    codes = torch.randn(int(positive.sum()), POINT_CODE) * 0.1
    pooled = torch.randint(0, n, (batch, regions * per_region))
    prefix = torch.cat([torch.randn(batch * regions, per_region, 3) * 0.8, torch.rand(batch * regions, per_region, 2)], -1)
    labels, residuals = torch.randint(0, 2, (batch * regions,)).float(), torch.randn(batch * regions, 7) * 0.1
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, betas=(0.9, 0.99), fused=True)

    def step():
        features = network.points(xyz, values)
        flat = features.transpose(1, 2).reshape(batch * n, -1)
        logits, said = network.cls(flat), network.box(flat)
        p = torch.sigmoid(logits)
        miss = one_hot * (1 - p) + (1 - one_hot) * p
        entropy = F.binary_cross_entropy_with_logits(logits, one_hot, reduction="none")
        count = max(1, int(positive.sum()))
        loss = ((0.75 - 0.5 * one_hot) * miss.square() * entropy).sum() / count
        loss = loss + smooth_l1(said[positive] - codes).sum() / count
        with torch.no_grad():
            of_regions = rows(features.transpose(1, 2), pooled).view(batch * regions, per_region, -1)
        refined = network.regions(prefix, of_regions)
        loss = loss + F.binary_cross_entropy_with_logits(network.roi_cls(refined)[:, 0], labels)
        loss = loss + smooth_l1(network.roi_box(refined) - residuals).sum(-1).mean()
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10)
        with torch.no_grad():
            torch._foreach_mul_(list(network.parameters()), 1 - 1e-4 * 0.01)
        optimizer.step()

    return step
