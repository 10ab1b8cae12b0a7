//! Sets the path on which programs find MuJoCo's library.

/// Adds the library's folder to the rpath of every program and test of the package, so that they need no environment
/// variable, and the program's own folder, for a program that is installed without the clone. The rpath is set here
/// because a dependency's link arguments do not reach the final binary.
fn main() {
    println!("cargo:rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(dir) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{dir}:$ORIGIN");
    }
}
