//! Where programs find MuJoCo's library.

/// Lets every program and test of a package find MuJoCo's library without environment variables: a
/// dependency's link arguments do not reach the final binary, so the rpath is set here.
fn main() {
    println!("cargo:rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    if let Ok(dir) = std::env::var("MUJOCO_DYNAMIC_LINK_DIR") {
        println!("cargo:rustc-link-arg=-Wl,-rpath,{dir}");
    }
}
