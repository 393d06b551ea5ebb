//! `cargo xtask bench gpu` on a machine without a GPU.

use std::process::Command;

#[test]
#[cfg(target_os = "linux")]
fn without_a_gpu_it_says_so_and_writes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let (devices, out) = (dir.path().join("dev"), dir.path().join("out"));
    std::fs::create_dir(&devices).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_xtask"));
    command.args(["bench", "gpu", "--", "--devices"]).arg(&devices).arg("--out").arg(&out);
    let output = command.output().unwrap();
    assert_eq!(output.status.code(), Some(1));
    let text = String::from_utf8(output.stderr).unwrap();
    assert!(text.contains("this machine has no GPU") && text.contains("nothing was written"), "{text}");
    assert!(output.stdout.is_empty() && !out.exists());
}
