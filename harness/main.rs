//! The program `harness`: prepares the process and runs [`harness::cli`].

use mimalloc::MiMalloc;
use std::process::ExitCode;

/// The allocator keeps freed memory. Each training step allocates and frees the same hundreds of megabytes. The
/// system's allocator returns this memory to the system, which must clear every page again: a sixth of a step's time.
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;

fn main() -> ExitCode {
    harness::cli::prepare_process();
    // SAFETY: no thread has been started yet.
    unsafe {
        harness::simulation::prepare_rendering();
        harness::learning::prepare_threads();
    }
    let program = std::env::current_exe().unwrap_or_else(|_| "harness".into());
    harness::cli::main(std::env::args_os().collect(), vec![program.to_string_lossy().into_owned()])
}
