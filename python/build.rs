//! Where the package finds MuJoCo's library: beside itself, in the wheel of `mujoco` that it depends on.

fn main() {
    println!("cargo:rustc-link-arg-cdylib=-Wl,-rpath,$ORIGIN/../mujoco");
}
