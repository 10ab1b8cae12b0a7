//! What the compiler has to be told: candle's version.

const LOCK: &str = "../../Cargo.lock";

/// The version of candle in the lock file, for the stamps of the tables.
fn candle_version() -> Option<String> {
    let lock = std::fs::read_to_string(LOCK).ok()?;
    let (_, after) = lock.split_once("name = \"candle-core\"\nversion = \"")?;
    Some(after.split_once('"')?.0.to_owned())
}

fn main() {
    println!("cargo:rerun-if-changed={LOCK}");
    println!("cargo:rustc-env=CANDLE_VERSION={}", candle_version().unwrap_or_else(|| "unknown".into()));
}
