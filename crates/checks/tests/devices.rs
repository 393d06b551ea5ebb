//! Comparison with reference values on every device of this build and this machine, and on the CPU with older
//! instruction sets.

#[allow(dead_code, reason = "each test file uses a part of it")]
mod program;

use program::{golden, must, output_text, program, run};

#[test]
fn reference_numbers_on_every_device() {
    let mut devices = Vec::new();
    for device in ["flex", "ndarray", "wgpu", "cuda"] {
        let output = run(&golden("synthetic/pointpillars_tiny"), &format!("parity . --device {device}"));
        let text = output_text(&output);
        if output.status.success() {
            devices.push(device);
            for network in ["pointrcnn_tiny", "centerpoint_tiny"] {
                must(&golden(&format!("synthetic/{network}")), &format!("parity . --device {device}"));
            }
        } else {
            let absent = ["was built without the feature", "no adapter"].iter().any(|reason| text.contains(reason));
            assert!(absent, "{device}: {text}");
            eprintln!("not tested: {}", text.trim());
        }
    }
    assert!(devices.starts_with(&["flex", "ndarray"]), "{devices:?}");
}

/// Emulates processors without newer instructions by restricting the instruction set.
#[test]
fn reference_numbers_with_fewer_instructions() {
    for set in ["portable", "avx2"] {
        for network in ["pointpillars_tiny", "pointrcnn_tiny", "centerpoint_tiny"] {
            let output = program(&golden(&format!("synthetic/{network}")), "parity .")
                .env("LIDARSHIFT_SIMD", set)
                .output()
                .unwrap();
            assert!(output.status.success(), "{set}, {network}: {}", output_text(&output));
        }
    }
    let unknown =
        program(&golden("synthetic/pointpillars_tiny"), "parity .").env("LIDARSHIFT_SIMD", "avx9").output().unwrap();
    assert_eq!(unknown.status.code(), Some(1));
    assert!(output_text(&unknown).contains("portable, neon, avx2 or avx512"), "{}", output_text(&unknown));
}
