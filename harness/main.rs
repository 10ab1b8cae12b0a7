//! The command line of the harness: arguments, terminal and exit codes; nothing scientific.

mod cli;

use clap::Parser;
use mimalloc::MiMalloc;
use std::process::ExitCode;

/// A training step allocates and frees the same hundreds of megabytes as the step before. The system's allocator
/// hands them back and has every page cleared again, a sixth of a step's time; this one keeps them.
#[global_allocator]
static ALLOCATOR: MiMalloc = MiMalloc;
/// `mi_option_purge_delay` of mimalloc.h (versions 2 and 3), to which the bindings give no name.
const PURGE_DELAY: libmimalloc_sys::mi_option_t = 15;
const NEVER: std::ffi::c_long = -1;

fn main() -> ExitCode {
    // SAFETY: nothing has started a thread yet, and the option is a number that may be set at any time.
    unsafe {
        // Rust ignores the signal, and `harness query … | head` would end in a panic.
        libc::signal(libc::SIGPIPE, libc::SIG_DFL);
        harness::simulation::prepare_rendering();
        harness::learning::prepare_threads();
        libmimalloc_sys::mi_option_set(PURGE_DELAY, NEVER);
    }
    cli::main(cli::Arguments::parse())
}
