"""Times training steps of the networks, inference and the costliest layers in PyTorch, on made-up inputs of given sizes.

Reads the report of `lidarshift-checks bench-step --json` and builds the same network from the configuration in it, so that both sides have the
same layers, the same number of points and the same number of pillars. Prints one line of JSON.

What the reference is spared: reading and augmenting, making pillars, anchors and targets, proposals and their suppression. The times here
begin with tensors in memory and end with updated weights; those of an inference end with decoded boxes, not yet suppressed.
"""

import argparse
import json
import resource
import sys
import time


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", help="JSON of `lidarshift-checks bench-step --json`")
    parser.add_argument("--form", choices=["openpcdet", "best"], default="openpcdet")
    parser.add_argument("--threads", type=int, required=True)
    parser.add_argument("--steps", type=int, required=True)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument(
        "--precision",
        choices=["default", "f32", "tf32", "f16"],
        default="default",
        help="of products on cuda; PyTorch's default is TF32 in convolutions and f32 in linear layers; f16: autocast",
    )
    arguments = parser.parse_args()
    with open(arguments.report) as file:
        report = json.load(file)

    import torch

    torch.set_num_threads(arguments.threads)
    torch.manual_seed(0)
    torch.set_default_device(arguments.device)
    if arguments.precision != "default":
        is_tf32 = arguments.precision != "f32"
        torch.backends.cudnn.allow_tf32 = torch.backends.cuda.matmul.allow_tf32 = is_tf32
    torch.backends.cudnn.benchmark = arguments.form == "best"
    wait = torch.cuda.synchronize if arguments.device == "cuda" else lambda: None
    config = report["config"]
    if config["network"]["kind"] == "pointpillars":
        import pointpillars

        points, pillars = report["read"]
        best = arguments.form == "best"
        make = {
            "step": pointpillars.make_step,
            "inference": pointpillars.make_inference,
            "convolutions": pointpillars.make_convolutions,
            "pillar-net": pointpillars.make_pillar_net,
        }[report["work"]]
        step = make(config, report["batch"], points, pillars, best)
    elif config["network"]["kind"] == "centerpoint":
        import centerpoint

        step = centerpoint.make_step(config, report["batch"], *report["read"])
    else:
        import pointrcnn

        step = pointrcnn.make_step(config, report["batch"])

    times_ms = []
    for i in range(arguments.steps + 2):  # two to warm up
        begin = time.perf_counter()
        with torch.autocast(arguments.device, torch.float16, enabled=arguments.precision == "f16"):
            step()
        wait()
        if i >= 2:
            times_ms.append(1e3 * (time.perf_counter() - begin))
    peak_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
    device_mib = torch.cuda.max_memory_reserved() >> 20 if arguments.device == "cuda" else None
    json.dump({"torch": torch.__version__, "whole_ms": times_ms, "peak_mib": peak_mib, "device_mib": device_mib}, sys.stdout)
    print()


if __name__ == "__main__":
    main()
