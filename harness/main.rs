//! The command line of the harness: arguments, terminal and exit codes; nothing scientific.

mod cli;

use clap::Parser;
use std::process::ExitCode;

fn main() -> ExitCode {
    // SAFETY: nothing has started a thread yet.
    unsafe { harness::simulation::prepare_rendering() };
    cli::main(cli::Arguments::parse())
}
