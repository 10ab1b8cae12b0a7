//! Sets the environment variable `CANDLE_VERSION` for the compiler.

const LOCK: &str = "../../Cargo.lock";

/// Returns candle's version from the lock file. It is recorded with the results.
fn candle_version() -> Option<String> {
    let lock = std::fs::read_to_string(LOCK).ok()?;
    let (_, after) = lock.split_once("name = \"candle-core\"\nversion = \"")?;
    Some(after.split_once('"')?.0.to_owned())
}

fn main() {
    println!("cargo:rerun-if-changed={LOCK}");
    println!("cargo:rustc-env=CANDLE_VERSION={}", candle_version().unwrap_or_else(|| "unknown".into()));
}
