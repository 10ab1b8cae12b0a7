//! Build script: passes a hash of the sources of a report's pictures to the compiler. The cache of pictures uses it.

use std::hash::{DefaultHasher, Hasher};
use std::path::Path;

/// Everything that pictures of the simulated scenes depend on: the sources of this crate and of the project's crates
/// that it uses, the models, and the versions of all dependencies.
const SOURCES: &[&str] = &[
    "../analysis",
    "../catalog",
    "../charts",
    "../claims",
    "../figures",
    "../judge",
    "../kernels",
    "../learning",
    "../metrics",
    "../ops",
    "../registry",
    "../samples",
    "../shared",
    "../simulation",
    "../spec",
    "../sql",
    "../tables",
    ".",
    "../../models",
    "../../Cargo.lock",
];

/// The hash of all [`SOURCES`], in 16 hexadecimal digits.
fn sources() -> String {
    let mut hasher = DefaultHasher::new();
    for path in SOURCES {
        println!("cargo:rerun-if-changed={path}");
        hash(Path::new(path), &mut hasher);
    }
    format!("{:016x}", hasher.finish())
}

/// Adds a file to the hash, or all files of a folder in the order of their names.
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
    println!("cargo:rustc-env=HARNESS_SOURCES={}", sources());
}
