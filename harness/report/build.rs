//! What the compiler has to be told: of what the pictures in a report are made.

use std::hash::{DefaultHasher, Hasher};
use std::path::Path;

/// All that decides a picture of the simulated world: the sources of the crates that this one is made of, the models, and
/// the versions of what they use.
const SOURCES: &[&str] = &[
    "../analysis",
    "../claims",
    "../dataset",
    "../figures",
    "../kernels",
    "../learning",
    "../metrics",
    "../registry",
    "../shared",
    "../simulation",
    "../spec",
    "../tables",
    ".",
    "../../models",
    "../../Cargo.lock",
];

/// Their hash.
fn sources() -> String {
    let mut hasher = DefaultHasher::new();
    for path in SOURCES {
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
    println!("cargo:rustc-env=HARNESS_SOURCES={}", sources());
}
