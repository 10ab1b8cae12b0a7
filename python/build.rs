//! Sets the path on which the extension finds MuJoCo's library: the wheel `mujoco` next to it in site-packages.

fn main() {
    println!("cargo:rustc-link-arg-cdylib=-Wl,-rpath,$ORIGIN/../mujoco");
}
