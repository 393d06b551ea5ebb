//! Prints the JSON schema of `diagnosis.json`: `cargo run -p lidarshift-diagnose --example schema > docs/src/reference/diagnosis.schema.json`.

#[expect(clippy::print_stdout, reason = "results go to stdout")]
fn main() {
    print!("{}", lidarshift_diagnose::diagnosis::schema_json());
}
