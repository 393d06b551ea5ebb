"""CenterPoint with pillars (Yin et al. 2021): a training step as OpenPCDet runs it, with padded pillars and images NCHW."""

import torch
import torch.nn.functional as F
from torch import nn

from bev import INPUTS_BESIDE_CHANNELS, Encoder, make_cells, make_points

BOXES = 10  # boxes of a frame
CODE = {"center": 2, "center_z": 1, "dim": 3, "rot": 2}


class PillarLayer(nn.Module):
    """All but the last compute half of their channels and append the pillar's maximum over them."""

    def __init__(self, inputs, filters, last):
        super().__init__()
        self.last = last
        filters = filters if last else filters // 2
        self.linear = nn.Linear(inputs, filters, bias=False)
        self.norm = nn.BatchNorm1d(filters, eps=1e-3, momentum=0.01)

    def forward(self, x):  # [P, M, F] -> [P, M, C] or [P, C]
        y = self.linear(x)
        y = F.relu(self.norm(y.view(-1, y.shape[2])).view(y.shape))
        most = y.max(dim=1, keepdim=True)[0]
        return most[:, 0] if self.last else torch.cat([y, most.expand_as(y)], dim=2)


class Network(Encoder):
    def __init__(self, config):
        net = config["network"]
        filters = net["vfe_filters"]
        super().__init__(config, filters[-1])
        inputs = [config["channels"] + INPUTS_BESIDE_CHANNELS] + filters
        self.vfe = nn.Sequential(*(PillarLayer(inputs[i], filters[i], i + 1 == len(filters)) for i in range(len(filters))))
        head = net["head"]
        wide, bias = head["filters"], head["bias_before_norm"]
        hidden = lambda before: nn.Sequential(nn.Conv2d(before, wide, 3, 1, 1, bias=bias), nn.BatchNorm2d(wide), nn.ReLU())
        self.shared_conv = hidden(self.neck)
        self.heads_list = nn.ModuleList()
        self.classes = [len(classes) for classes in head["classes"]] or [len(config["classes"])]
        for classes in self.classes:
            branches = nn.ModuleDict()
            for name, channels in {**CODE, "hm": classes}.items():
                layers = [hidden(wide) for _ in range(head["layers"][name] - 1)]
                branches[name] = nn.Sequential(*layers, nn.Conv2d(wide, channels, 3, 1, 1))
            nn.init.constant_(branches["hm"][-1].bias, -2.19)
            self.heads_list.append(branches)

    def heads(self, x):
        x = self.shared_conv(self.features(x))
        return [{name: branch(x) for name, branch in branches.items()} for branches in self.heads_list]


def heat_map_loss(logits, truth):
    p = torch.sigmoid(logits).clamp(min=1e-4, max=1 - 1e-4)
    peaks = truth.eq(1).float()
    near = torch.log(p) * torch.pow(1 - p, 2) * peaks
    far = torch.log(1 - p) * torch.pow(p, 2) * torch.pow(1 - truth, 4) * truth.lt(1).float()
    return -(near.sum() + far.sum()) / peaks.sum().clamp(min=1)


def make_step(config, batch, points, pillars):
    """One step on `points` points in `pillars` pillars, of `batch` frames together."""
    network = Network(config)
    padded, _, _ = make_points(config, points, pillars)
    cells = make_cells(batch, pillars, network.ny * network.nx)
    optimizer = torch.optim.Adam(network.parameters(), lr=1e-4, betas=(0.9, 0.99))
    targets = []

    def make_targets(maps):
        frames, classes, height, width = maps["hm"].shape
        truth = torch.rand(frames, classes, height, width) * 0.5
        at = torch.randint(0, height * width, (frames, BOXES))
        truth.view(frames, classes, -1)[:, 0].scatter_(1, at, 1.0)
        targets.append((truth, at, torch.randn(frames, BOXES, sum(CODE.values())) * 0.1))

    def step():
        predictions = network.heads(network.canvas(network.vfe(padded), cells, batch, False))
        if not targets:
            for maps in predictions:
                make_targets(maps)
        loss = 0
        for maps, (truth, at, code) in zip(predictions, targets):
            boxes = torch.cat([maps[name] for name in CODE], dim=1).permute(0, 2, 3, 1).contiguous().flatten(1, 2)
            found = boxes.gather(1, at[..., None].expand(-1, -1, boxes.shape[2]))
            loss = loss + heat_map_loss(maps["hm"], truth) + 2 * (found - code).abs().sum() / (batch * BOXES)
        optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 10)
        with torch.no_grad():
            torch._foreach_mul_(list(network.parameters()), 1 - 1e-4 * 0.01)
        optimizer.step()

    return step
