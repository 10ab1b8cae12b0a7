//! Compiles the CUDA kernels to PTX, if there is a GPU to compute on.

fn main() {
    #[cfg(feature = "cuda")]
    compile_kernels();
}

#[cfg(feature = "cuda")]
fn compile_kernels() {
    println!("cargo::rerun-if-changed=cuda");
    let out = std::path::PathBuf::from(std::env::var_os("OUT_DIR").expect("cargo sets OUT_DIR"));
    let ptx = cudaforge::KernelBuilder::new()
        .source_dir("cuda")
        .no_incremental()
        .arg("-O3")
        .arg("-std=c++17")
        .build_ptx();
    let written = ptx.and_then(|ptx| ptx.write(out.join("ptx.rs")));
    if let Err(error) = written {
        println!("cargo::error=the CUDA kernels can't be compiled: {error}");
        std::process::exit(1);
    }
}
