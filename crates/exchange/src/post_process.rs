//! The script that applies what a program cannot express to its finished clouds.

use crate::frames::Head;
use sensor::EffectList;

/// The remaining list and its script; nothing if nothing remains.
pub(crate) fn files(head: &Head, remaining: &EffectList) -> Vec<(String, String)> {
    if remaining.effects.is_empty() {
        return Vec::new();
    }
    let list = toml::to_string(remaining).expect("a list is plain data");
    let list = format!("{}\n{list}", head.comment("#", &["For finished clouds.".into()]));
    let script = SCRIPT.replace("@HEAD@", head.comment("#", &[]).trim_end());
    vec![("post_process.toml".into(), list), ("post_process.py".into(), script)]
}

const SCRIPT: &str = r#"#!/usr/bin/env python3
@HEAD@
"""Applies post_process.toml to finished clouds.

    python post_process.py IN.npy OUT.npy       one cloud, N x 4: x, y, z (m), intensity
    python post_process.py DATASET --out DIR    a data set, by the program lidarshift

Clouds are in the frame x forward, y left, z up. Clouds of CARLA have y to the right: negate y first.
One cloud needs the Python package lidarshift. A data set needs the program lidarshift in PATH.
"""

import argparse
import pathlib
import subprocess
import sys

MODEL = pathlib.Path(__file__).with_name("post_process.toml")


def apply(points, seed=0, frame=0):
    """The points with all remaining effects applied. points: N x 4, float32. frame: number of the cloud."""
    import lidarshift

    return lidarshift.apply_effects(points, MODEL, seed=seed, frame=frame)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", help="IN.npy or the folder of a data set")
    parser.add_argument("target", nargs="?", help="OUT.npy")
    parser.add_argument("--out", help="folder for the new data set")
    parser.add_argument("--rig", help="TOML with the poses and patterns of the sensors")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if options.source.endswith(".npy"):
        if options.target is None:
            parser.error("the name of the new file is missing: post_process.py IN.npy OUT.npy")
        import numpy

        numpy.save(options.target, apply(numpy.load(options.source).astype(numpy.float32), options.seed))
        return 0
    if options.out is None:
        parser.error("--out is missing: the folder for the new data set")
    command = ["lidarshift", "resim", "--effects", str(MODEL), options.source, "--out", options.out]
    command += ["--seed", str(options.seed)]
    if options.rig:
        command += ["--sensor", options.rig]
    return subprocess.call(command)


if __name__ == "__main__":
    sys.exit(main())
"#;
