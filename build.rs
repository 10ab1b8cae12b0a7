//! What the compiler has to be told: where MuJoCo's library lies, candle's version, and what the program is made of.

use std::hash::{DefaultHasher, Hasher};
use std::path::Path;

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

/// A hash of all that decides what the program does: its sources, the models, the versions of what it uses.
fn sources() -> String {
    let mut hasher = DefaultHasher::new();
    for path in ["harness", "models", "Cargo.lock"] {
        println!("cargo:rerun-if-changed={path}");
        hash(Path::new(path), &mut hasher);
    }
    format!("{:016x}", hasher.finish())
}

/// Adds a file, or those of a folder by their names.
fn hash(path: &Path, hasher: &mut DefaultHasher) {
    hasher.write(path.as_os_str().as_encoded_bytes());
    if path.is_dir() {
        let mut paths: Vec<_> =
            std::fs::read_dir(path).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        paths.sort();
        paths.iter().for_each(|path| hash(path, hasher));
    } else {
        hasher.write(&std::fs::read(path).unwrap_or_default());
    }
}

fn main() {
    set_rpath();
    println!("cargo:rustc-env=HARNESS_SOURCES={}", sources());
    println!("cargo:rustc-env=CANDLE_VERSION={}", candle_version().unwrap_or_else(|| "unknown".into()));
}
