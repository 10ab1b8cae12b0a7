//! What the compiler has to be told: where MuJoCo's library lies, and candle's version.

/// Lets every binary and test of this package find MuJoCo's library without environment variables: a
/// dependency's link arguments do not reach the final binary, so the rpath is set here.
fn set_rpath() {
    println!("cargo:rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(dir) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{dir}");
    }
}

/// The version of candle in the lock file, for the stamps of the tables.
fn candle_version() -> Option<String> {
    let lock = std::fs::read_to_string("Cargo.lock").ok()?;
    let (_, after) = lock.split_once("name = \"candle-core\"\nversion = \"")?;
    Some(after.split_once('"')?.0.to_owned())
}

fn main() {
    set_rpath();
    println!("cargo:rerun-if-changed=Cargo.lock");
    println!("cargo:rustc-env=CANDLE_VERSION={}", candle_version().unwrap_or_else(|| "unknown".into()));
}
