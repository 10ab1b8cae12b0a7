//! The checked-in MJCF and the script that composes it.

use std::path::Path;
use std::process::Command;

#[test]
fn the_script_still_produces_what_is_checked_in() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv/bin/python");
    let output = Command::new(python).arg(root.join("models/compose.py")).arg("--check").output().unwrap();
    let said = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "run `.venv/bin/python models/compose.py`:\n{said}");
}
