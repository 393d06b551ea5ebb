"""PointPillars (Lang et al. 2019): a training step, an inference, and the costliest layers, in two forms.

As OpenPCDet runs it: pillars padded to their full number of points, images NCHW, box losses over all anchors. `best`: the points alone with
the padding's exact share in the statistics, images channels-last, box losses over the positive anchors, a fused optimiser.
"""

import torch
import torch.nn.functional as F
from torch import nn

from bev import INPUTS_BESIDE_CHANNELS, Encoder, PillarNet, make_cells, make_points

POSITIVES = 60  # anchors of a frame that have a box


class Network(Encoder):
    def __init__(self, config):
        net = config["network"]
        super().__init__(config, net["vfe_filters"])
        self.vfe = PillarNet(config["channels"] + INPUTS_BESIDE_CHANNELS, net["vfe_filters"], net["pillars"]["max_points"])
        self.classes = len(config["classes"])
        self.bins = net["head"]["dir_bins"]
        self.anchors = sum(len(anchor["rotations_rad"]) for anchor in net["anchors"])
        self.conv_cls = nn.Conv2d(self.neck, self.anchors * self.classes, 1)
        self.conv_box = nn.Conv2d(self.neck, self.anchors * 7, 1)
        self.conv_dir_cls = nn.Conv2d(self.neck, self.anchors * self.bins, 1)
        nn.init.constant_(self.conv_cls.bias, -4.595)
        nn.init.normal_(self.conv_box.weight, std=0.001)

    def heads(self, x):
        batch, x = x.shape[0], self.features(x)
        heads = [(self.conv_cls, self.classes), (self.conv_box, 7), (self.conv_dir_cls, self.bins)]
        return [conv(x).permute(0, 2, 3, 1).reshape(batch, -1, k) for conv, k in heads]


def focal(logits, one_hot, weights):
    p = torch.sigmoid(logits)
    alpha = one_hot * 0.25 + (1 - one_hot) * 0.75
    miss = one_hot * (1 - p) + (1 - one_hot) * p
    entropy = logits.clamp(min=0) - logits * one_hot + torch.log1p(torch.exp(-logits.abs()))
    return (alpha * miss.square() * entropy * weights[..., None]).sum()


def box_loss(said, truth):
    heading, true_heading = said[..., 6:], truth[..., 6:]
    said = torch.cat([said[..., :6], torch.sin(heading) * torch.cos(true_heading)], dim=-1)
    truth = torch.cat([truth[..., :6], torch.cos(heading) * torch.sin(true_heading)], dim=-1)
    n = (said - truth).abs()
    return torch.where(n < 1 / 9, 4.5 * n.square(), n - 0.5 / 9)


def make_inference(config, batch, points, pillars, best):
    """From decorated points to decoded boxes of the best anchors; batch norm not folded, boxes not suppressed."""
    network = Network(config).eval()
    padded, rows, pillar = make_points(config, points, pillars)
    cells = make_cells(batch, pillars, network.ny * network.nx)
    if best:
        network = network.to(memory_format=torch.channels_last)
    keep = config["network"]["detection"]["nms_pre"]
    anchors = {}

    def pillar_features():
        net = network.vfe
        if not best:
            return net.padded(padded)
        y = F.relu(F.batch_norm(net.linear(rows), net.norm.running_mean, net.norm.running_var, net.norm.weight, net.norm.bias, False, 0, 1e-3))
        out = y.new_zeros(pillars, y.shape[1])
        return out.scatter_reduce(0, pillar[:, None].expand(-1, y.shape[1]), y, "amax", include_self=True)

    @torch.inference_mode()
    def inference():
        cls, boxes, bins = network.heads(network.canvas(pillar_features(), cells, batch, best))
        if not anchors:
            anchors["all"] = torch.rand(cls.shape[1], 7) + 1
        scores, at = torch.sigmoid(cls).max(dim=-1)[0].topk(min(keep, cls.shape[1]), dim=1)
        pick = lambda tensor: tensor.gather(1, at[..., None].expand(-1, -1, tensor.shape[2]))
        code, anchor = pick(boxes), anchors["all"][at]
        diagonal = anchor[..., 3:5].norm(dim=-1, keepdim=True)
        centre = code[..., :3] * torch.cat([diagonal, diagonal, anchor[..., 5:6]], -1) + anchor[..., :3]
        heading = code[..., 6:] + anchor[..., 6:] + torch.pi * pick(bins).argmax(-1, keepdim=True)
        return torch.cat([centre, anchor[..., 3:6] * code[..., 3:6].exp(), heading], -1), scores

    return inference


def make_convolutions(config, batch, points, pillars, best):
    """Each of the backbone's 3x3 convolutions of stride 1, forward and backward; `best`: channels-last."""
    network = Network(config)
    layout = torch.channels_last if best else torch.contiguous_format
    work, height, width = [], network.ny, network.nx
    for filters, stride, count in zip(*(config["network"]["backbone"][key] for key in ("filters", "strides", "layers"))):
        height, width = -(-height // stride), -(-width // stride)
        conv = nn.Conv2d(filters, filters, 3, 1, 1, bias=False).to(memory_format=layout)
        x, dy = (torch.randn(batch, filters, height, width).contiguous(memory_format=layout) for _ in range(2))
        work += [(conv, x.requires_grad_(), dy)] * count

    def convolutions():
        for conv, x, dy in work:
            x.grad = conv.weight.grad = None
            conv(x).backward(dy)

    return convolutions


def make_pillar_net(config, batch, points, pillars, best):
    """The pillar feature net, forward and backward; `best`: valid points only."""
    net = Network(config).vfe
    padded, rows, pillar = make_points(config, points, pillars)
    dy = torch.randn(pillars, net.linear.out_features)

    def pillar_net():
        net.zero_grad()
        (net.of_points(rows, pillar, pillars) if best else net.padded(padded)).backward(dy)

    return pillar_net


def make_step(config, batch, points, pillars, best):
    """One step on `points` points in `pillars` pillars, of `batch` frames together."""
    network = Network(config)
    padded, rows, pillar = make_points(config, points, pillars)
    cells = make_cells(batch, pillars, network.ny * network.nx)
    if best:
        network = network.to(memory_format=torch.channels_last)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, betas=(0.9, 0.99), fused=best or None)
    targets = {}

    def make_targets(anchors):
        positive = torch.stack([torch.randperm(anchors)[:POSITIVES] for _ in range(batch)])
        labels = torch.zeros(batch, anchors, dtype=torch.long).scatter_(1, positive, 1)
        targets["one_hot"] = F.one_hot(labels, network.classes + 1)[..., 1:].float()
        targets["positive"], targets["is_positive"] = positive, (labels > 0).float() / POSITIVES
        targets["boxes"] = torch.randn(batch, anchors, 7) * 0.1
        targets["bins"] = torch.randint(0, network.bins, (batch, anchors))

    def step():
        features = network.vfe.of_points(rows, pillar, pillars) if best else network.vfe.padded(padded)
        cls, boxes, bins = network.heads(network.canvas(features, cells, batch, best))
        if not targets:
            make_targets(cls.shape[1])
        loss = focal(cls, targets["one_hot"], torch.full(cls.shape[:2], 1 / POSITIVES)) / batch
        if best:
            index = targets["positive"][..., None]
            pick = lambda tensor: tensor.gather(1, index.expand(-1, -1, tensor.shape[2]))
            box = box_loss(pick(boxes), pick(targets["boxes"])).sum() / POSITIVES
            direction = F.cross_entropy(pick(bins).flatten(0, 1), targets["bins"].gather(1, targets["positive"]).flatten())
        else:
            weights = targets["is_positive"]
            box = (box_loss(boxes, targets["boxes"]) * weights[..., None]).sum()
            of_all = F.cross_entropy(bins.flatten(0, 1), targets["bins"].flatten(), reduction="none")
            direction = (of_all.view_as(weights) * weights).sum() / batch
        loss = loss + 2 * box / batch + 0.2 * direction
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10)
        with torch.no_grad():
            torch._foreach_mul_(list(network.parameters()), 1 - 1e-4 * 0.01)
        optimizer.step()

    return step
