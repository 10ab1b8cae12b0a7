//! The binary: prepares the process and runs [`harness::cli`].

use mimalloc::MiMalloc;
use std::process::ExitCode;

/// A training step allocates and frees the same hundreds of megabytes as the step before. The system's allocator
/// hands them back and has every page cleared again, a sixth of a step's time; this one keeps them.
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;

fn main() -> ExitCode {
    harness::cli::prepare_process();
    // SAFETY: nothing has started a thread yet.
    unsafe {
        harness::simulation::prepare_rendering();
        harness::learning::prepare_threads();
    }
    harness::cli::main(std::env::args_os())
}
